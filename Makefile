# make demo, make test: everything from a fresh clone, with Python ≥ 3.11 and make alone.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
TOOLS = $(VENV)/.tools
SITE = $(VENV)/.site
# The matrices are small: threads of linear algebra would only wait for each other.
ONE_THREAD = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

.PHONY: demo test test-slow check format bench soak docs site clean

# An environment; the extras of $(1) in it, and $(2) says what for.
define environment
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or later is needed, not " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	@test -x $(BIN)/python || { echo "Making an environment in $(VENV)"; $(PYTHON) -m venv $(VENV); }
	@echo "Installing $(2) into $(VENV), once: a minute or so"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(1)]'
	@touch $@
endef

$(READY): pyproject.toml
	$(call environment,all,triaxcal and what a station needs)

$(TOOLS): pyproject.toml | $(READY)
	$(call environment,test,what the tests need)

$(SITE): pyproject.toml | $(TOOLS)
	$(call environment,docs,what the documentation needs)

demo: $(READY)  ## the whole line on two simulated units
	@echo "Calibrating two simulated units: about a minute"
	$(BIN)/triaxcal demo --out demo-out

# Two processes more than processors: some tests wait for a bus, and others work meanwhile.
WORKERS = $(shell $(BIN)/python -c 'import os; print(min(os.cpu_count(), 8) + 2)')
PYTEST = $(ONE_THREAD) $(BIN)/python -m pytest -q --instafail -n $(WORKERS) --dist worksteal
test: $(TOOLS)  ## the tests, in some minutes
	@echo "Testing: some four minutes on two cores; make test-slow runs the rest"
	$(PYTEST) -m "not slow"

test-slow: $(TOOLS)  ## many seeds, whole processes, a CAN kernel: half an hour on two cores
	$(PYTEST) -m slow

bench: $(TOOLS)  ## the tables of docs/benchmarks.md, some minutes; BENCH=quick for fewer runs, within one
	$(ONE_THREAD) $(BIN)/python -m benchmarks $(if $(filter quick,$(BENCH)),--quick)

SOAK ?= 20m
soak: $(TOOLS)  ## a recorder while everything fails at random, 20 minutes; SOAK=2m for less, SEED=7 for the same faults again
	$(ONE_THREAD) $(BIN)/python -m benchmarks.soak --time $(SOAK) $(if $(SEED),--seed $(SEED))

docs: $(SITE)  ## pages and the picture made from the code, the notebook with its outputs, and the site
	$(BIN)/python docs/reference/python.py
	$(BIN)/python docs/reference/profile.py
	$(BIN)/python docs/reference/documents.py
	$(BIN)/python docs/reference/effects.py
	$(BIN)/python docs/reference/cli.py
	$(BIN)/python docs/reference/many.py
	$(BIN)/python docs/reference/misbehaving-devices.py
	$(BIN)/python docs/reference/profile-keys.py
	$(BIN)/python docs/pictures/before_after.py
	$(BIN)/python docs/tutorial/execute.py
	$(MAKE) site

site: $(SITE)  ## the documentation as pages in site/; fails where a link leads nowhere
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "Open site/index.html"

check: $(TOOLS)  ## lint, format, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

format: $(TOOLS)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo-out dist build site .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis .cache
