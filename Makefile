# Every target does its own set-up in .venv: the demo needs the package alone, all others the tools as well.
# PYTHON may be any Python from 3.11 on.
PYTHON ?= python3
VENV := .venv
CONSTRAINTS := constraints.txt
BIN := $(VENV)/bin
# One process more than there are cores: some tests wait for others. The tests of one file share what they made. Files
# are taken in the order of tests/conftest.py: the longest first.
PYTEST := $(BIN)/pytest -n $(shell $(PYTHON) -c 'import os; print(os.cpu_count() + 1)') --dist loadfile --no-loadscope-reorder
PACKAGE := $(VENV)/.package
TOOLS := $(VENV)/.tools
KERNELS := $(VENV)/.kernels
# What is imported is compiled once, also where the environment says that nothing is to be kept.
unexport PYTHONDONTWRITEBYTECODE

# uv installs in seconds what takes pip a minute. It does not read the settings of pip, so it is told them; where it
# cannot be had, or fails, pip does it. Not with UV_TORCH_BACKEND, which pip does not know: it would take a build with CUDA.
SETTINGS := s/^[^=]*\.index-url=/export UV_DEFAULT_INDEX=/p; s/^[^=]*\.extra-index-url=/export UV_INDEX=/p; \
  s/^[^=]*\.cert=/export SSL_CERT_FILE=/p; s/^[^=]*\.find-links=/export UV_FIND_LINKS=/p
define install
	eval "$$($(BIN)/pip config list | sed -n '$(SETTINGS)')"; \
	UV_INDEX_STRATEGY=unsafe-best-match $(BIN)/uv pip install --quiet --python $(BIN)/python -c $(CONSTRAINTS) -e '$(1)' || \
	{ test -z "$$UV_TORCH_BACKEND" && \
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile -c $(CONSTRAINTS) -e '$(1)'; }
endef

.PHONY: kernels test test-all test-newest test-unit test-slow test-demo test-faults check demo notebooks docs package clean

$(PACKAGE): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	-$(BIN)/pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) uv
	$(call install,.[segmentation])
	touch $@

$(TOOLS): $(PACKAGE)
	$(call install,.[dev])
	touch $@

# Compiled once: else each process of the tests would compile the same functions at the same time, a minute each.
$(KERNELS): $(TOOLS) gnss_sem_map/cli/kernels.txt
	$(BIN)/python -m gnss_sem_map.cli.compile_ahead
	touch $@

kernels: $(KERNELS)

# Laws, oracles and one whole run of each kind.
test: $(KERNELS)
	$(PYTEST) -m 'not slow and not demo and not faults'

# These and the thorough checks.
test-all: $(KERNELS)
	$(PYTEST) -m 'not demo and not faults'

# The tests with the newest of every dependency, which is what a user of pip gets; torch alone is held, or pip takes its
# build for GPUs.
test-newest:
	mkdir -p build && grep ^torch== constraints.txt > build/newest.txt
	$(MAKE) test VENV=.venv-newest CONSTRAINTS=build/newest.txt

# What every change should pass at once: no process is started, no drive simulated, no real data read.
test-unit: $(TOOLS)
	$(PYTEST) -m 'not slow and not demo and not faults and not integration'

# Executed in build/notebooks, where the site finds them with their pictures; the last one takes longest and begins first.
notebooks: $(TOOLS)
	rm -rf build/notebooks && mkdir -p build/notebooks && cp examples/*.ipynb build/notebooks
	$(PYTEST) --nbmake --nbmake-timeout=600 --overwrite $$(ls -r build/notebooks/*.ipynb)

# The documentation site, in build/site; a link that leads nowhere is an error.
docs: $(TOOLS)
	$(BIN)/mkdocs build --quiet --strict

demo: $(PACKAGE)
	$(BIN)/gnss-sem-map demo

# Wheel and sdist, and a short demo from the wheel: an empty environment, an empty folder, no torch.
package: $(TOOLS)
	rm -rf dist && $(BIN)/python -m build --outdir dist
	set -e; place=$$(mktemp -d); trap 'rm -rf $$place' EXIT; \
	$(PYTHON) -m venv $$place/venv; \
	$$place/venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl; \
	mkdir $$place/empty; cd $$place/empty; ../venv/bin/gnss-sem-map demo --seconds 3

# The thorough checks alone. With PART='--splits 8 --group 1', an eighth of them.
test-slow: $(KERNELS)
	$(PYTEST) -m 'slow and not faults' $(PART)

test-demo: $(TOOLS)
	$(PYTEST) -m demo

test-faults: $(TOOLS)
	$(PYTEST) tests/faults

check: $(TOOLS)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) .venv-newest build dist *.egg-info
