PYTHON ?= python3
PYTHON_OLDEST ?= python3.11
VENV := .venv
OLDEST := .venv-oldest
INSTALLED := $(VENV)/.installed
SEED ?= 0

.PHONY: demo test quick test-slow test-oldest fuzz lint docs clean

# The matrices are small: one thread computes faster than several that wait for each other. Files of tests run side by side.
PYTEST := OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest
SIDE_BY_SIDE := --numprocesses auto --maxprocesses 4 --dist loadfile
QUICK := architecture calibrate cameras config elimination extrinsics initialise io layer losses metrics noise observations se3 \
	solvers trajectories workers

demo: $(INSTALLED)
	$(VENV)/bin/torchstickcal demo --out demo

test: $(INSTALLED)
	$(PYTEST) $(SIDE_BY_SIDE)

quick: $(INSTALLED)
	$(PYTEST) $(SIDE_BY_SIDE) $(QUICK:%=tests/test_%.py)

test-slow: $(INSTALLED)
	$(PYTEST) -m slow

test-oldest: $(OLDEST)/.installed
	OMP_NUM_THREADS=1 $(OLDEST)/bin/python -m pytest $(SIDE_BY_SIDE)

fuzz: $(INSTALLED)
	TORCHSTICKCAL_FUZZ=large $(PYTEST) tests/fuzz --hypothesis-seed=$(SEED)

lint: $(INSTALLED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

docs: $(VENV)/.docs-installed
	$(VENV)/bin/mkdocs build --strict

$(VENV)/.docs-installed: $(INSTALLED)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $(VENV)/.docs-installed

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(INSTALLED)

$(OLDEST)/.installed: pyproject.toml constraints-oldest.txt
	$(PYTHON_OLDEST) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-oldest.txt -e ".[test]"
	touch $(OLDEST)/.installed

clean:
	rm -rf $(VENV) $(OLDEST) demo build dist site *.egg-info
