# Every target works on a fresh machine with Python >= 3.11: the virtual environment is made and filled as needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out
# `make test CONSTRAINTS=` in a new checkout takes the newest versions instead.
CONSTRAINTS ?= constraints.txt
PIP_INSTALL := $(BIN)/python -m pip install --quiet $(addprefix -c ,$(CONSTRAINTS))

.PHONY: atlas test validate faults versions lint bench validation gallery docs help clean

atlas: $(VENV)/installed  ## the quickstart chart, its atlas and their figure, in out/
	@mkdir -p $(OUT)
	$(BIN)/drivetrain run sweeps/quickstart.toml --out $(OUT)/quickstart.nc
	$(BIN)/drivetrain run sweeps/cardan_atlas.toml --out $(OUT)/cardan_atlas.nc
	$(BIN)/drivetrain plot $(OUT)/quickstart.nc $(OUT)/cardan_atlas.nc --out $(OUT)/quickstart.png

test: $(VENV)/installed-test lint  ## all tests in their short form
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not full and not docs"

validate: $(VENV)/installed-test  ## the comparisons at full size
	$(BIN)/python -m pytest -n 2 --dist worksteal -m full

faults: $(VENV)/installed-test  ## kills, failing writes and damaged bytes at random; writes the table of docs/reliability.md
	$(BIN)/python tests/faults/crashes.py
	$(BIN)/python -m pytest -m full tests/runs/test_resume_machine.py

versions: $(VENV)/installed  ## the lowest and the newest versions of all dependencies, on every Python; writes the table of docs/reliability.md
	$(BIN)/python tests/versions.py

lint: $(VENV)/installed-test  ## style, formatting, spelling, types, directions of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/python -m pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

bench: $(VENV)/installed-bench  ## error against run time, with the peers; writes benchmarks/results/, docs/benchmarks.md and the figures of README.md
	$(BIN)/drivetrain bench

validation: $(VENV)/installed-bench  ## regenerates docs/validation/
	$(BIN)/python -m benchmarks.validation

gallery: $(VENV)/installed  ## every scene of sweeps/ and its figure, in out/gallery/
	$(BIN)/python docs/gallery.py $(OUT)/gallery

docs: $(VENV)/installed-docs $(VENV)/installed-test  ## the documentation site, in out/docs/html: links, examples, commands and generated parts checked
	$(BIN)/python -m pytest -n 2 -m docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html -d $(OUT)/docs/doctrees docs $(OUT)/docs/html
	$(BIN)/python -m sphinx -q -W --keep-going -b doctest -d $(OUT)/docs/doctrees docs $(OUT)/docs/doctest

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/python
	$(PIP_INSTALL) -e .
	@touch $@

$(VENV)/installed-test: $(VENV)/installed
	$(PIP_INSTALL) -e '.[test]'
	@touch $@

$(VENV)/installed-bench: $(VENV)/installed
	$(PIP_INSTALL) -e '.[bench]'
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(PIP_INSTALL) -e '.[docs]'
	@touch $@

help:  ## this list
	@sed -n 's/^\([a-z]*\):.*##  *\(.*\)/\1\t\2/p' Makefile | expand -t 12

clean:  ## removes the virtual environment and out/
	rm -rf $(VENV) $(OUT)
