# Verbs, not recipes: people and CI call the same ones.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BUILT := $(VENV)/.built
NATIVE := $(wildcard sb3_torcs/native/*.* sb3_torcs/native/*/*)
SCRIPTS := .ci/run $(filter-out %.py %.cpp %.md,$(wildcard tools/*))
SHELL := /bin/bash
CORES := $(shell env -u OMP_NUM_THREADS nproc)
# One more than cores: some tests wait for the game or the browser.
WORKERS ?= $(shell echo $$(($(CORES) < 8 ? $(CORES) + 1 : 8)))

export PYTHON
# One thread per process: on few cores torch's own threads get in each other's way.
export OMP_NUM_THREADS ?= 1
export PYTHONHASHSEED = 0
MAKEFLAGS += --no-print-directory

.DEFAULT_GOAL := help

help: ## show the verbs
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 18

# What the game needs may be missing where nothing can be installed.
demo: ## get all it takes, and watch a car learn to lap (three minutes; Ctrl-C keeps what was learned)
	@tools/get-packages python engine video || echo "== going on with what is here"
	@$(MAKE) install
	@$(MAKE) native game || echo "== without the engine or the game; make native game shows why"
	$(BIN)/python examples/demo.py $(DEMO_ARGS)

test: ## get all it takes, check format, lint and types, and run every test
	@tools/get-packages python engine video browser
	@$(MAKE) install native game
	@tools/run-beside "$(MAKE) check-codestyle" "$(MAKE) lint" "$(MAKE) type" -- \
	  $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations=10

test-rare: native game browser ## run the tests that take long and rarely find anything
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m rare

install: $(STAMP) ## put everything but the engine into .venv/

$(STAMP): setup.cfg pyproject.toml constraints.txt
	@tools/get-packages python
	@tools/make-environment $(VENV)
	@touch $@

native: $(BUILT) ## build the engine in place

# Removed first: a process that has loaded a library keeps the one that it has.
$(BUILT): $(STAMP) setup.py $(NATIVE)
	@tools/get-packages engine
	rm -f sb3_torcs/*.so
	$(BIN)/python setup.py build_ext --inplace
	@touch $@

game: install ## get TORCS and Xvfb, if they are not here
	@tools/get-packages video
	$(BIN)/sb3-torcs install-torcs --video

browser: ## get Chromium, in which tests open the pages, if it is not here
	@tools/get-packages browser

pytest: native game browser ## run the tests that do not train
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m 'not slow and not rare'

lock: install ## choose the newest versions that go together, for constraints.txt
	@{ echo "# Made by make lock: the versions that make and CI take, for Python 3.11 to 3.14"; \
	  echo uv | $(BIN)/python -m uv pip compile --quiet --universal --python-version 3.11 --all-extras \
	    --no-header --no-annotate --no-emit-package tfp-nightly setup.cfg -; } > constraints.new
	mv constraints.new constraints.txt

test-newest test-oldest: test-%: ## run every test with the newest versions, or the oldest allowed
	@VERSIONS=$* $(MAKE) VENV=build/$* test

check-machines: ## check what make test cannot: other Debians, sanitizers, other versions (hours; root)
	@tools/check-machines

wheels: install ## build wheels into dist/: with the engine for each Python here, and without it
	$(BIN)/python tools/build_wheels.py

# Python itself leaks by design and is built without the sanitizers and without C++: they are loaded
# before it.
sanitize: install game ## run the engine's tests under AddressSanitizer and UBSan
	@rm -f $(BUILT) sb3_torcs/*.so
	SB3_TORCS_SANITIZE=1 $(BIN)/python setup.py build_ext --inplace \
	  --build-lib build/sanitized --build-temp build/sanitized
	LD_PRELOAD="$$($${CXX:-c++} -print-file-name=libasan.so) $$($${CXX:-c++} -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
	  $(BIN)/python -m pytest -p no:xdist tests/test_native*.py
	@$(MAKE) native

docs: install ## build the documentation as a site, in build/docs/
	$(BIN)/python tools/build_docs.py

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

lint: install ## lint code, scripts, workflows and hyperparameter files
	$(BIN)/ruff check .
	$(BIN)/yamllint --strict zoo_configs examples/studies .github
	$(BIN)/shellcheck --severity warning $(SCRIPTS)
	@includes="$$($(BIN)/python -c 'import pybind11, sysconfig; \
	  print("-isystem", pybind11.get_include(), "-isystem", sysconfig.get_path("include"))')"; set -x; \
	  printf '%s\n' $(filter %.cpp,$(NATIVE)) | \
	  xargs -P $(CORES) -I FILE $(BIN)/clang-tidy --quiet FILE -- -std=c++17 $$includes

type: install ## check types
	$(BIN)/mypy

commit-checks: format lint type ## what to run before a commit

clean: ## remove .venv/ and what was built; trainings stay
	rm -rf build dist *.egg-info sb3_torcs/*.so $(VENV)

.PHONY: help demo test test-rare install native game browser pytest lock test-newest test-oldest \
  check-machines wheels sanitize docs bench format check-codestyle lint type commit-checks clean
