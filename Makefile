# The two commands a newcomer types:  make demo   make test
PYTHON ?= python3
VENV   ?= .venv
RUN    := $(VENV)/bin/python
READY  := $(VENV)/.ready

.PHONY: demo test lint types arrows docs unit pictures lock clean help

help:        ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(READY): pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint requirements.lock --editable '.[plots,images,test,docs]'
	@touch $@

demo: $(READY)  ## fly the 700 s step demonstration on simulated hardware and print its report
	@rm -rf runs/demo
	$(RUN) -m flight run config/step_demo.yaml --out runs/demo
	$(RUN) -m flight report runs/demo

test: $(READY)  ## every check, two at a time
	@$(MAKE) --no-print-directory --jobs 2 lint types arrows docs unit

lint: $(READY)  ## style
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check --quiet .

types: $(READY)  ## strict types
	$(VENV)/bin/mypy

arrows: $(READY)  ## the architecture's import arrows
	$(VENV)/bin/lint-imports --no-cache

docs: $(READY)  ## the documentation site, strict, into build/site
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet --site-dir build/site
	$(RUN) -m tests.docs.built_site build/site

unit: $(READY)  ## the tests, on all cores
	$(RUN) -m pytest -n auto --dist loadfile

pictures: $(READY)  ## the README's pictures
	$(RUN) -m tests.studies.pictures

lock: $(READY)  ## write down the versions in use
	$(VENV)/bin/pip freeze --exclude-editable > requirements.lock

clean:       ## forget the virtual environment and the runs
	rm -rf $(VENV) runs build *.egg-info
