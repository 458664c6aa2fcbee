# Two commands set everything up on a fresh machine: `make scan` and `make test`.

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/stamps
OUTPUT := output
# The first Python of at least 3.11; the wheels of ROS 2 end at 3.13.
PYTHON := $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null \
	&& echo $$p && break; done)
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
INTERFACES := $(shell find src/sl_interfaces -type f)
PACKAGES := sl_common sl_projector sl_camera sl_reconstruct sl_calibration sl_bench sl_bringup
SOURCES := $(foreach p,$(PACKAGES),src/$(p)/$(p))
PYTEST := $(BIN)/python -m pytest
# Extras of pyproject.toml that are installed; continuous integration adds some (.ci/run).
EXTRAS := ros,dev

export MYPYPATH := $(subst $() ,:,$(foreach p,$(PACKAGES),src/$(p)))

.PHONY: help scan test check types docs wheel workspace paper bench venv clean distclean
.DEFAULT_GOAL := help

help: ## this text
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

scan: venv ## install, start bench and graph, calibrate, scan the V-groove, show numbers and pictures
	@$(BIN)/slrig scan --up --bench --calibrate --surface groove --measure groove --output $(OUTPUT)/groove

test: venv ## install, run all tests
	@$(PYTEST) -n 2 --dist loadfile

check: venv ## style, types, import directions: under a minute
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(MAKE) --no-print-directory types
	@$(PYTEST) -q tests/common/test_architecture.py

types: venv ## types alone
	@$(BIN)/mypy $(SOURCES)

docs: $(STAMPS)/docs ## the manual and the API as a site in output/site; a warning is an error
	@$(BIN)/python -m mkdocs build --quiet --site-dir $(OUTPUT)/site
	@echo "the site is in $(OUTPUT)/site/index.html"

wheel: venv ## the wheels, tried in an environment and a folder of their own
	@.ci/wheel

workspace: ## colcon build of all packages; every node starts from the workspace
	@.ci/workspace

paper: venv ## the paper's Table 2 and Figs. 10 and 11 on the bench, beside the paper's numbers
	@$(BIN)/python benchmarks/paper/reproduce.py --output $(OUTPUT)/paper

bench: venv ## speed and memory
	@set -e; for b in benchmarks/bench_*.py; do echo "== $$b"; $(BIN)/python $$b; done

venv: ## everything installed into .venv
	@$(MAKE) --no-print-directory -s -j 2 $(STAMPS)/installed

clean: ## remove what was made, keep the environment
	rm -rf build install log $(OUTPUT) .pytest_cache .mypy_cache .ruff_cache
	find src tests benchmarks -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## remove the environment as well
	rm -rf $(VENV)

$(STAMPS)/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11, 3.12 or 3.13 is needed; none was found" >&2; exit 1; }
	@command -v c++ >/dev/null || { echo "a C++ compiler is needed to build the messages (Debian, Ubuntu: apt install g++)" >&2; exit 1; }
	@echo "making $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv $(VENV)
	@mkdir -p $(STAMPS) && touch $@

# These two run side by side: one waits for downloads while the other compiles.
$(STAMPS)/runtime: pyproject.toml $(STAMPS)/python
	@echo "installing the runtime, ROS 2 and the tools"
	@$(PIP) install -e '.[$(EXTRAS)]'
	@touch $@

$(STAMPS)/docs: pyproject.toml $(STAMPS)/installed
	@echo "installing what the site is built with"
	@$(PIP) install -e '.[docs]'
	@touch $@

$(STAMPS)/wheel: $(INTERFACES) $(STAMPS)/python
	@echo "building the messages, services and actions (sl_interfaces)"
	@rm -rf $(VENV)/wheels
	@$(PIP) wheel --no-deps -w $(VENV)/wheels ./src/sl_interfaces
	@touch $@

$(STAMPS)/installed: $(STAMPS)/runtime $(STAMPS)/wheel
	@$(PIP) install --force-reinstall --no-deps $(VENV)/wheels/*.whl
	@touch $@
	@echo "installed"
