# Every target does its own set-up in .venv: the demo needs the package alone, all others the tools as well.
# PYTHON may be any Python from 3.11 on.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGE := $(VENV)/.package
TOOLS := $(VENV)/.tools

.PHONY: test test-slow test-faults check demo notebooks clean

$(PACKAGE): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[segmentation]'
	touch $@

$(TOOLS): $(PACKAGE)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

test: $(TOOLS)
	$(BIN)/pytest -m 'not slow and not faults'

notebooks: $(TOOLS)
	$(BIN)/pytest --nbmake --nbmake-timeout=600 examples

demo: $(PACKAGE)
	$(BIN)/gnss-sem-map demo

test-slow: $(TOOLS)
	$(BIN)/pytest -m slow

test-faults: $(TOOLS)
	$(BIN)/pytest tests/faults

check: $(TOOLS)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) build dist *.egg-info
