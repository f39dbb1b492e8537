# The two commands a newcomer types:  make demo   make test
PYTHON ?= python3
VENV   ?= .venv
RUN    := $(VENV)/bin/python
READY  := $(VENV)/.ready
TESTS  := $(RUN) -m pytest -n auto
# The tests start hundreds of processes: without kept bytecode each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo cage orbit orbit-3u object console quick test test-container lint types arrows docs house unit fast slow-list pictures lock clean help

help:           ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

# Python compiles a module when it first imports it, and keeps that: most of what is installed is never imported.
$(READY): pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --no-compile --config-settings editable_mode=compat --constraint requirements.lock --editable '.[plots,images,test,docs,interop]'
	@touch $@

demo: $(READY)  ## fly the 700 s step demonstration on simulated hardware and print its report
	@rm -rf runs/demo
	$(RUN) -m flight run config/step_demo.yaml --out runs/demo
	$(RUN) -m flight report runs/demo

cage: $(READY)  ## fly the testbed in a Helmholtz cage that plays an orbit's field, for a revolution; report and pictures
	@rm -rf runs/cage
	$(RUN) -m flight run config/cage.yaml --out runs/cage
	$(RUN) -m flight report runs/cage --figures runs/cage/figures

orbit: $(READY) ## fly a KnightCube for an orbit: detumble from 10 deg/s, point to the Sun, then nadir; print the report
	@rm -rf runs/orbit
	$(RUN) -m flight run config/orbit.yaml --out runs/orbit
	$(RUN) -m flight report runs/orbit

orbit-3u: $(READY) ## the same with a 3U, for two and a half hours of flight
	@rm -rf runs/orbit_3u
	$(RUN) -m flight run config/orbit_3u.yaml --out runs/orbit_3u
	$(RUN) -m flight report runs/orbit_3u

object: $(READY) ## a 3U finds an object that passes, follows it, and determines its orbit: two and a half minutes of flight
	@rm -rf runs/object
	$(RUN) -m flight run config/orbit_object.yaml --out runs/object
	$(RUN) -m flight orbit runs/object --opm runs/object/orbits

console: $(READY) ## the demonstration flying in real time in the browser, with forms to command it
	@rm -rf runs/console
	$(RUN) -m flight console runs/console --fly config/step_demo.yaml --open

quick: $(READY) ## style, import arrows and the fast tests: under 90 s on two cores
	@$(MAKE) --no-print-directory lint arrows fast

test: $(READY)  ## every check, two at a time
	@$(MAKE) --no-print-directory --jobs 2 lint types arrows docs unit

test-container: $(READY)  ## the service installed and booted under systemd in a container; needs root and nspawn
	$(RUN) -m pytest -rs tests/deploy/test_container.py

lint: $(READY)  ## style
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check --quiet .

types: $(READY) ## strict types
	$(VENV)/bin/mypy

arrows: $(READY) ## which package may import which
	$(VENV)/bin/lint-imports --no-cache

docs: $(READY)  ## the documentation site, strict, into build/site
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet --site-dir build/site
	$(RUN) -m tests.docs.built_site build/site

house: $(READY) ## packages, layers, imports and sizes, drawn from the source
	$(RUN) -m tests.studies.house

unit: $(READY)  ## the tests, on all cores
	$(TESTS) --dist loadfile

fast: $(READY)  ## the tests that are not slow, on all cores
	$(TESTS) --dist worksteal -m "not slow"

slow-list: $(READY)  ## measure every test alone and write tests/slow.txt
	$(RUN) -m pytest --write-slow-list

pictures: $(READY) ## the README's pictures
	$(RUN) -m tests.studies.pictures

lock: $(READY)  ## write down the versions in use, and with hashes those of a board
	$(VENV)/bin/pip freeze --all --exclude pip --exclude-editable | LC_ALL=C sort --ignore-case > requirements.lock
	$(PYTHON) -m venv build/lock && build/lock/bin/pip install --quiet pip-tools
	build/lock/bin/pip-compile --quiet --generate-hashes --all-build-deps --allow-unsafe --strip-extras --no-annotate \
	  --no-header --no-emit-options --constraint requirements.lock --output-file - pyproject.toml > build/lock/board
	{ echo '# What a board needs, by hash: written by `make lock`, used by deploy/install.sh with --require-hashes.'; \
	  grep -E '^([A-Za-z]|    --hash)' build/lock/board; \
	} > deploy/requirements.lock

clean:          ## forget the virtual environment and the runs
	rm -rf $(VENV) runs build *.egg-info
