# make demo: a map of a simulated flight. make test: what has to pass. Both make their own environment in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TRAINS := $(VENV)/.trains
SEEDS ?= 101 102 103

.PHONY: demo test check bench

demo: $(READY)
	$(BIN)/sorvolo demo demo-site

test: check $(TRAINS)
	$(BIN)/python -m pytest -n 2

check: $(TRAINS)
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)
	$(BIN)/python benchmarks/mosaic_methods.py $(SEEDS)

$(READY): requirements.lock pyproject.toml setup.py $(wildcard src/sorvolo/kernels/*.?pp)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	touch $@

$(TRAINS): $(READY) requirements-training.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock -r requirements-training.lock
	touch $@
