# Verbs, not recipes: people and CI call the same ones.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BUILT := $(VENV)/.built
NATIVE := $(wildcard sb3_torcs/native/*.* sb3_torcs/native/*/*)
SOURCES := setup.py $(NATIVE)
SHELL := /bin/bash
SUDO := $(if $(filter 0,$(shell id -u)),,sudo)
BROWSER := $(SUDO) apt-get install --yes --no-install-recommends chromium chromium-driver

# One thread per process: on few cores torch's own threads get in each other's way.
export OMP_NUM_THREADS ?= 1
export PYTHONHASHSEED = 0

.DEFAULT_GOAL := help

help: ## show the verbs
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 18

install: $(STAMP) ## put everything into .venv/

$(STAMP): setup.cfg pyproject.toml setup.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python is $$($(PYTHON) --version 2>&1), 3.11 or newer is needed; try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "Python cannot make a virtual environment; type: sudo apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet --upgrade pip
	@if ! $${CXX:-c++} --version >/dev/null 2>&1; then export SB3_TORCS_WITHOUT_ENGINE=1; fi; \
	  set -x; $(BIN)/python -m pip install --progress-bar on --editable '.[tests]'
	@$${CXX:-c++} --version >/dev/null 2>&1 || \
	  echo "There is no C++ compiler: the engine of Torcs-v0 is missing. For it type: sudo apt install g++ python3-dev; make native"
	@touch $@

demo: install ## watch a car learn to lap, and record its best lap (three minutes; Ctrl-C keeps what was learned)
	$(BIN)/python examples/demo.py $(DEMO_ARGS)

native: $(BUILT) ## build the engine in place, and fail if that cannot be done

# A machine that has no compiler installs everything but the engine.
$(BUILT): $(STAMP) $(SOURCES)
	$(BIN)/python -m pip install --verbose --no-deps --editable .
	@touch $@

game: install ## get TORCS and Xvfb, if they are not here
	$(BIN)/sb3-torcs install-torcs --video

# Debian's packages; elsewhere a test says what it needs.
browser: ## get Chromium, in which tests open the pages, if it is not here
	@command -v chromium >/dev/null && command -v chromedriver >/dev/null || { set -x; \
	  $(BROWSER) || { $(SUDO) apt-get update && $(BROWSER); }; }

test: native game browser check-codestyle lint type ## check format, lint and types, and run every test
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations=10

pytest: native game browser ## run the tests that do not train
	$(BIN)/python -m pytest -n 2 -m 'not slow'

# Python itself leaks by design and is built without the sanitizers and without C++: they are loaded
# before it.
sanitize: install game ## run the engine's tests under AddressSanitizer and UBSan
	@rm -f $(BUILT)
	SB3_TORCS_SANITIZE=1 $(BIN)/python -m pip install --verbose --no-deps --editable .
	LD_PRELOAD="$$($${CXX:-c++} -print-file-name=libasan.so) $$($${CXX:-c++} -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
	  $(BIN)/python -m pytest -p no:xdist tests/test_native*.py
	@echo "the engine is built with the sanitizers now; type: make native"

bench: install ## measure speeds
	$(BIN)/sb3-torcs bench

format: install ## sort imports and format
	$(BIN)/ruff check --select I --fix --quiet .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(NATIVE)

check-codestyle: install ## check the format only
	$(BIN)/ruff check --select I .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(NATIVE)

lint: install ## lint code and hyperparameter files
	$(BIN)/ruff check .
	$(BIN)/yamllint --strict zoo_configs examples/studies
	@includes="$$($(BIN)/python -c 'import pybind11, sysconfig; \
	  print("-isystem", pybind11.get_include(), "-isystem", sysconfig.get_path("include"))')"; set -x; \
	  printf '%s\n' $(filter %.cpp,$(NATIVE)) | \
	  xargs -P "$$(env -u OMP_NUM_THREADS nproc)" -I FILE $(BIN)/clang-tidy --quiet FILE -- -std=c++17 $$includes

type: install ## check types
	$(BIN)/mypy

commit-checks: format lint type ## what to run before a commit

clean: ## remove .venv/ and what was built; trainings stay
	rm -rf build dist *.egg-info $(VENV)

.PHONY: help install native game browser demo test pytest sanitize bench format check-codestyle lint type commit-checks clean
