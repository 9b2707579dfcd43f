# make demo, make test: everything from a fresh clone, with Python ≥ 3.11 and make alone.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
# The matrices are small: threads of linear algebra would only wait for each other.
ONE_THREAD = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

.PHONY: demo test check format bench docs clean

$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or later is needed, not " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[station,test]'
	touch $@

demo: $(READY)  ## the whole line on two simulated units
	$(BIN)/triaxcal demo --out demo-out

# Two processes more than processors: some tests wait for a bus, and others work meanwhile.
WORKERS = $(shell $(BIN)/python -c 'import os; print(min(os.cpu_count(), 8) + 2)')
test: $(READY)  ## the whole test suite
	$(ONE_THREAD) $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal

bench: $(READY)  ## the tables of docs/benchmarks.md, some minutes; BENCH=quick for fewer runs, within one
	$(ONE_THREAD) $(BIN)/python -m benchmarks $(if $(filter quick,$(BENCH)),--quick)

check: $(READY)  ## lint, format, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo-out dist build .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
