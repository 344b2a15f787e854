# Two commands lead in: `make demo` and `make test`. Each makes its own virtual environment first.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-all test-long lint bench bench-check fuzz settings docs docs-notebooks figures clean

demo: $(VENV)/.installed
	$(BIN)/lio-jax demo --out out/demo --overwrite

# A file's tests stay in one process: they share drives and programs. A process that dies ends the run,
# because the others would wait for its tests for ever.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --max-worker-restart 0

test: $(VENV)/.installed-dev
	$(PYTEST) -m "not long"

test-long: $(VENV)/.installed-dev
	$(PYTEST) -m long --durations=20

test-all: $(VENV)/.installed-dev
	$(PYTEST) --durations=20

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.installed-bench
	$(BIN)/python experiments/bench/lidar_vs_peers.py

# Short benchmarks beside experiments/bench/baseline.json: fails if one has become slower or less accurate.
bench-check: $(VENV)/.installed-bench
	$(BIN)/python experiments/bench/bench_check.py

# Damaged files through the command line: N of them, the same ones for the same SEED. Failures stay in out/fuzz/kept.
N ?= 1000
SEED ?= 0
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m experiments.fuzz --inputs $(N) --seed $(SEED)

# The site, in site/index.html. With executed notebooks in out/notebooks their pictures are on the pages.
docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-notebooks: $(VENV)/.installed-dev
	$(BIN)/python docs/hooks/execute_notebooks.py notebooks out/notebooks

# The pictures of the pages, made anew by the simulator. With DRIVE=.../2011_09_26_drive_0005_sync, that of KITTI, too.
GALLERY := $(filter-out docs/gallery/picture.py docs/gallery/kitti.py,$(wildcard docs/gallery/*.py))
DRIVE ?=
figures: $(VENV)/.installed-dev
	$(BIN)/python docs/figures/symptoms.py
	set -e; for script in $(GALLERY); do $(BIN)/python $$script; done
	$(if $(DRIVE),$(BIN)/python docs/gallery/kitti.py $(DRIVE))

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) --editable .
	touch $@

# The library of Ouster captures pins dependencies that contradict ours; what the tests need of it works without them.
OUSTER := $(INSTALL) --no-deps ouster-sdk

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) --editable '.[dev]'
	$(OUSTER)
	touch $@ $(VENV)/.installed

$(VENV)/.installed-bench: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) --editable '.[dev,bench]'
	$(OUSTER)
	touch $@ $(VENV)/.installed $(VENV)/.installed-dev

settings: $(VENV)/.installed
	$(BIN)/python -m lio_jax.settings.generate configs/recipes docs/settings.md

clean:
	rm -rf $(VENV) build dist site *.egg-info
