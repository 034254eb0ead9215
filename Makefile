# Needs python3 (3.10 or newer) with its venv module; everything else goes into .venv.
# PIP_ARGS reaches pip: on a machine without an NVIDIA card,
#   make demo PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"
# takes the much smaller CPU build of PyTorch.

PYTHON ?= python3
PIP_ARGS ?=
PYTEST_ARGS ?=
BENCH_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: all demo test lint format bench clean

all: demo

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("colmap-tco needs Python 3.10 or newer; name one with make PYTHON=…" if sys.version_info < (3, 10) else 0)'
	@$(PYTHON) -c 'import ensurepip, venv' || { echo "Python's venv module is missing; on Debian: apt install python3-venv" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check $(PIP_ARGS) --constraint constraints.txt --editable ".[dev,hub,las,da3,evaluate]"
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps depth-anything-3==0.1.1 || echo "Without the package depth-anything-3, --backbone da3 and its tests are left out" >&2
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps nerfstudio==1.1.5 || echo "Without the package nerfstudio, the test of its reader is left out" >&2
	@touch $@

demo: $(STAMP)
	$(BIN)/python -m examples.demo

test: $(STAMP)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/python -m benchmarks $(BENCH_ARGS)

clean:
	rm -rf build dist demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +
