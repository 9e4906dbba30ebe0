# One command sets up and runs: make demo, make test. Needs python3 (3.11 or newer) with venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
DEMO ?= demo
COUNT ?= 2000

.PHONY: demo test test-all fuzz faults lint docs figures bench samples clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@

demo: $(VENV)/installed
	$(BIN)/slam calibrate samples/course/square.png --side 0.3048 -o $(DEMO)/calibration.yaml --overwrite
	$(BIN)/slam stitch samples/course/frames -c $(DEMO)/calibration.yaml -o $(DEMO)/map --overwrite

test: $(VENV)/installed-dev lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

# And what is slow.
test-all: test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m slow

# Mutated files of every format, and extreme values of every option and field: each in a process of
# bounded time and memory.
BOUNDARIES ?= boundaries
fuzz: $(VENV)/installed-dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/robustness/fuzz.py --count $(COUNT)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/robustness/boundaries.py $(BOUNDARIES)

# Kills, full disks, vanished frames: minutes; as root, whose disks of some megabytes are mounted.
FAULTS ?= faults
faults: $(VENV)/installed-dev
	$(BIN)/python tests/robustness/faults.py $(FAULTS)/640x480 --kills 44 --disks 20
	$(BIN)/python tests/robustness/faults.py $(FAULTS)/1920x1080 --size 1920x1080 --frames 4 --kills 20 --disks 0

lint: $(VENV)/installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# Draws the pictures of the documentation anew, with the commands that the pages show.
figures: $(VENV)/installed
	$(BIN)/python docs/figures.py

# The stitching package brings another build of OpenCV: it gets a place of its own.
bench:
	$(PYTHON) -m venv $(VENV)-bench
	$(VENV)-bench/bin/python -m pip install --quiet --disable-pip-version-check . stitching pyorthomosaic
	$(VENV)-bench/bin/python benchmarks/peers.py
	$(VENV)-bench/bin/python benchmarks/surveys.py

samples: $(VENV)/installed
	$(BIN)/python samples/make.py

clean:
	rm -rf $(VENV) $(VENV)-bench $(DEMO) site
