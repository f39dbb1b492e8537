# The two commands a newcomer types:  make demo   make test
PYTHON ?= python3
VENV   ?= .venv
RUN    := $(VENV)/bin/python
READY  := $(VENV)/.ready
TOOLS  := $(VENV)/.tools
TESTS  := $(RUN) -m pytest -n auto
# The tests start hundreds of processes: without kept bytecode each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo cage orbit orbit-3u object console quick test test-container lint types arrows docs house unit fast explore slow-list pictures lock release clean help

help:           ## list the targets
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

# Python compiles a module when it first imports it, and keeps that: most of what is installed is never imported.
INSTALL := $(VENV)/bin/pip --disable-pip-version-check install --quiet --no-compile
$(READY): pyproject.toml knightcube/pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --require-hashes --no-deps -r requirements.lock
	$(INSTALL) --no-deps --no-build-isolation --editable ./knightcube --editable .
	@touch $@

$(TOOLS): $(READY) requirements-test.lock
	$(INSTALL) --require-hashes --no-deps -r requirements-test.lock
	@touch $@

demo: $(READY)  ## fly the 700 s step demonstration on simulated hardware and print its report
	@rm -rf runs/demo
	@# Without numba: to compile the functions for the first time takes longer than this flight.
	KNIGHTCUBE_COMPILED=0 $(RUN) -m flight run config/step_demo.yaml --out runs/demo
	$(RUN) -m flight report runs/demo

cage: $(READY)  ## fly the testbed for a revolution in a Helmholtz cage that reproduces the field of an orbit; report and pictures
	@rm -rf runs/cage
	$(RUN) -m flight run config/cage.yaml --out runs/cage
	$(RUN) -m flight report runs/cage --figures runs/cage/figures

orbit: $(READY) ## fly a KnightCube for an orbit: detumble from 10 deg/s, point to the Sun, then nadir; print the report
	@rm -rf runs/orbit
	$(RUN) -m flight run config/orbit.yaml --out runs/orbit
	$(RUN) -m flight report runs/orbit

orbit-3u: $(READY) ## fly a 3U in the same way, for two and a half hours of flight
	@rm -rf runs/orbit_3u
	$(RUN) -m flight run config/orbit_3u.yaml --out runs/orbit_3u
	$(RUN) -m flight report runs/orbit_3u

object: $(READY) ## fly a 3U that finds a passing object, follows it for two and a half minutes, and determine the object's orbit
	@rm -rf runs/object
	$(RUN) -m flight run config/orbit_object.yaml --out runs/object
	$(RUN) -m flight orbit runs/object --opm runs/object/orbits

console: $(READY) ## fly the demonstration in real time and show it in the browser, with forms for commands
	@rm -rf runs/console
	$(RUN) -m flight console runs/console --fly config/step_demo.yaml --open

quick: $(TOOLS) ## check style, import contracts and the fast tests: about 5 min on two hyperthreads
	@$(MAKE) --no-print-directory lint arrows fast

# The tests begin first: they wait for processes and sockets, and the other checks fill the pauses.
test: $(TOOLS)  ## run every check, two at a time
	@$(MAKE) --no-print-directory --jobs 2 unit lint types arrows docs

test-container: $(TOOLS)  ## install and boot the service under systemd in a container; needs root and systemd-nspawn
	$(RUN) -m pytest -rs tests/deploy/test_container.py

lint: $(TOOLS)  ## check the style
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check --quiet .

types: $(TOOLS) ## check the types strictly
	$(VENV)/bin/mypy

arrows: $(TOOLS) ## check which package imports which
	$(VENV)/bin/lint-imports --no-cache

docs: $(TOOLS)  ## build the documentation site into build/site; a warning is an error
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet --site-dir build/site
	$(RUN) -m tests.docs.built_site build/site

house: $(TOOLS) ## check the sizes of files, classes and functions
	$(RUN) -m tests.studies.house

unit: $(TOOLS)  ## run the tests on all cores
	$(TESTS) -rs --dist loadfile --no-loadscope-reorder

fast: $(TOOLS)  ## run the tests that are not slow on all cores
	$(TESTS) --dist worksteal -m "not slow"

explore: $(TOOLS) ## run the property tests with new random examples; `make test` uses the same examples each time
	$(TESTS) --dist worksteal -m hypothesis --hypothesis-profile explore

slow-list: $(TOOLS)  ## measure every test alone and write tests/slow.txt and tests/order.txt
	$(RUN) -m pytest --write-slow-list

pictures: $(TOOLS) ## draw the pictures of the documentation
	$(RUN) -m tests.studies.pictures

lock:           ## choose versions of all packages and store them with their hashes; versions that still fit are kept
	$(PYTHON) -m venv build/lock && build/lock/bin/pip install --quiet pip-tools hatchling
	build/lock/bin/pip wheel --quiet --no-deps --wheel-dir build/lock/wheels ./knightcube
	@# Each list takes the versions of the one before it, so that a board flies what the tests tested.
	$(call COMPILE,requirements-test.lock,pyproject.toml $(foreach extra,plots watch ground $(CHECKS),--extra $(extra)))
	$(call COMPILE,requirements.lock,pyproject.toml --constraint requirements-test.lock --extra plots --extra watch --extra ground)
	$(call COMPILE,deploy/requirements.lock,pyproject.toml --constraint requirements-test.lock)

CHECKS  := images parquet circuitpython test docs interop
# The library of this repository is installed from the clone: its entry goes.
COMPILE = build/lock/bin/pip-compile --quiet --generate-hashes --all-build-deps --allow-unsafe --strip-extras \
  --no-annotate --no-header --no-emit-options --find-links build/lock/wheels --output-file $(1) $(2) && \
  sed -i -e '/^knightcube==/,/[^\\]$$/d' -e '/^\#/d' $(1)

release: $(READY) ## sign the committed release and check its bundle as a board does (SIGNING=folder of renewal keys)
	@test -f "$(SIGNING)/signing.pem" || { echo "name the folder of \`knightcube renewal keys\`: make release SIGNING=folder" >&2; exit 2; }
	@test -z "$$(git status --porcelain)" || { echo "commit or remove the changes first: git status" >&2; exit 2; }
	@rm -rf build/release && mkdir -p build/release/source build/release/opened
	@git archive HEAD | tar -x -C build/release/source
	$(RUN) -m flight renewal sign "$(SIGNING)" release build/release/source --out build/release
	$(RUN) deploy/open_bundle.py build/release/trusted "$(SIGNING)/metadata/1.root.json" build/release/release-*.renewal release \
	  build/release/opened - -
	@cd build/release && sha256sum release-*.renewal

clean:          ## delete the virtual environment and the folders runs and build
	rm -rf $(VENV) runs build *.egg-info
