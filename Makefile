# One environment, made on first use and shared by every target.
VENV ?= .venv
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := $(VENV)/bin
READY := $(VENV)/.ready
OUT ?= quickstart

.DEFAULT_GOAL := help
.PHONY: help setup quickstart test test-slow check bench clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

setup: $(READY) ## create the environment (.venv) and install everything into it

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: partialbench needs Python 3.11 or newer; $(PYTHON) is older. Set PYTHON=..." >&2; exit 1; }
	@.ci/system-libraries
	@$(PYTHON) -m venv $(VENV) || \
		{ echo "error: no venv module; run: sudo apt-get install -y python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,test]'
	@touch $@

quickstart: $(READY) ## render, train, evaluate and write a leaderboard: the whole job, small
	$(BIN)/partialbench quickstart --out $(OUT)

test: $(READY) ## run the tests (slow, gpu and bench ones are behind markers)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(READY) ## run the slow tests too
	$(BIN)/python -m pytest -m "not gpu and not bench"

check: $(READY) ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY) ## measure speed against peers, in one run
	$(BIN)/python benchmarks/run.py

clean: ## remove the environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
