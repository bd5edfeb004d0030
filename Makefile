PYTHON ?= python3
VENV := .venv
INSTALLED := $(VENV)/.installed

.PHONY: demo test quick test-slow lint clean

# The matrices are small: one thread computes faster than several that wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest
QUICK := architecture calibrate cameras config elimination extrinsics initialise io layer losses metrics noise observations se3 \
	solvers trajectories workers

demo: $(INSTALLED)
	$(VENV)/bin/torchstickcal demo --out demo

test: $(INSTALLED)
	$(PYTEST)

quick: $(INSTALLED)
	$(PYTEST) $(QUICK:%=tests/test_%.py)

test-slow: $(INSTALLED)
	$(PYTEST) -m slow

lint: $(INSTALLED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(INSTALLED)

clean:
	rm -rf $(VENV) demo build dist *.egg-info
