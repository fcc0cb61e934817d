# make demo: a map of a simulated flight. make test: what has to pass, in 15 minutes; make test-long: the few tests of
# much work beside it. They make their own environment in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TRAINS := $(VENV)/.trains

.PHONY: demo test test-long check bench page-vendor wheel models-wheel docs

demo: $(READY)
	$(BIN)/sorvolo demo demo-site

# Two workers more than two cores: much of the tests' time is waiting for streams, processes and browsers.
test: check $(TRAINS)
	$(BIN)/python -m pytest -n 4 --dist worksteal -m "not long"

test-long: $(TRAINS)
	$(BIN)/python -m pytest -m long

check: $(TRAINS)
	$(BIN)/ruff format --check --quiet
	$(BIN)/ruff check --quiet
	$(BIN)/mypy --num-workers 2
	$(BIN)/lint-imports

# The published tables that take minutes (some 35 in all), at this commit: make bench [TABLES=NAME...] [DATA=FOLDER]
bench: $(READY)
	$(BIN)/python benchmarks/quick_tables.py $(TABLES) $(if $(DATA),--data $(DATA))

# dist/: an sdist, and a wheel made from it, which holds the compiled kernels: a C++17 compiler is needed.
PACKING := build/packing
wheel: $(PACKING)/.ready
	$(PACKING)/bin/python -m build --no-isolation --outdir dist .

# dist/: the models as a wheel of their own, for all platforms. build/models has all that it is made from.
models-wheel: build/models $(PACKING)/.ready
	$(PACKING)/bin/python -m build --no-isolation --wheel --outdir dist build/models

build/models: $(wildcard src/sorvolo/detection/data/*) models/pyproject.toml NOTICE
	rm -rf $@ && mkdir -p $@/sorvolo/detection
	cp -r src/sorvolo/detection/data $@/sorvolo/detection/
	cp -r models/pyproject.toml NOTICE LICENSES $@

$(PACKING)/.ready: requirements-build.lock
	$(PYTHON) -m venv $(PACKING)
	$(PACKING)/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-build.lock
	touch $@

# build/site/: this documentation as web pages; a broken link ends it with an error.
WRITING := build/docs-env
docs: $(WRITING)/.ready
	NO_MKDOCS_2_WARNING=1 $(WRITING)/bin/python -m mkdocs build --strict --site-dir build/site

# The libraries of the station's page, from npm, with their hashes and licences (needs npm; an install does not).
page-vendor:
	$(PYTHON) benchmarks/pack_page_libraries.py

$(WRITING)/.ready: requirements-docs.lock
	$(PYTHON) -m venv $(WRITING)
	$(WRITING)/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-docs.lock
	touch $@

# The locks name all that is needed, so nothing is resolved; bytecode is made of what is used. The kernels are compiled while
# the locks' packages are unpacked, one lock after the other: both name some of the same.
PIP := pip install --quiet --disable-pip-version-check --no-deps --no-compile
MAKEFLAGS += --jobs=2
unexport PYTHONDONTWRITEBYTECODE  # set in many containers: each process would compile all that it imports

$(READY): $(VENV)/.locked $(VENV)/.built
	touch $@

$(TRAINS): $(READY) $(VENV)/.training
	touch $@

$(VENV)/.made:
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.locked: requirements.lock | $(VENV)/.made
	$(BIN)/python -m $(PIP) -r requirements.lock
	touch $@

$(VENV)/.built: pyproject.toml setup.py $(wildcard src/sorvolo/kernels/*.?pp) | $(VENV)/.made
	$(BIN)/python -m $(PIP) -e .
	touch $@

$(VENV)/.training: $(addprefix requirements-,$(addsuffix .lock,test notebooks training torch)) | $(VENV)/.locked
	$(BIN)/python -m $(PIP) -r requirements-test.lock -r requirements-notebooks.lock
	$(BIN)/python -m $(PIP) -r requirements-training.lock
	$(BIN)/python -m $(PIP) -r requirements-torch.lock
	touch $@
