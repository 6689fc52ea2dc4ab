# Every target works on a fresh machine with Python >= 3.11: the virtual environment is made and filled as needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out

.PHONY: atlas test validate faults bench validation lint clean

atlas: $(VENV)/installed  ## the quickstart atlas and its figure, in out/
	@mkdir -p $(OUT)
	$(BIN)/drivetrain run sweeps/quickstart.toml --out $(OUT)/quickstart.nc
	$(BIN)/drivetrain plot $(OUT)/quickstart.nc --out $(OUT)/quickstart.png

test: $(VENV)/installed-test lint  ## all tests in their short form
	$(BIN)/python -m pytest -n 2 -m "not full"

validate: $(VENV)/installed-test  ## the comparisons at full size
	$(BIN)/python -m pytest -m full

faults: $(VENV)/installed-test  ## real faults at random moments; writes the table of docs/reliability.md
	$(BIN)/python tests/faults/suite.py

lint: $(VENV)/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

bench: $(VENV)/installed-bench  ## throughput and errors against the peers; results in benchmarks/results/
	$(BIN)/python -m benchmarks.throughput
	$(BIN)/python -m benchmarks.work_precision
	$(BIN)/python -m benchmarks.critical_speeds
	$(BIN)/python -m benchmarks.planetary_throughput
	$(BIN)/python -m benchmarks.rattle_throughput
	$(BIN)/python -m benchmarks.chaos
	$(BIN)/python -m benchmarks.scaling

validation: $(VENV)/installed  ## regenerates docs/validation/
	$(BIN)/python -m benchmarks.validation

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	@touch $@

$(VENV)/installed-test: $(VENV)/installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test]'
	@touch $@

$(VENV)/installed-bench: $(VENV)/installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[bench]'
	@touch $@

clean:
	rm -rf $(VENV) $(OUT)
