# Two entries do all set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test test-slow lint clean

demo: $(INSTALLED)
	$(BIN)/sagesplat demo

# two processes of one thread each: the tests are small, and idle threads would spin in each other's way
test: lint
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2

test-slow: $(INSTALLED)
	$(BIN)/pytest -q -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sagesplat needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || $(PYTHON) -m virtualenv $(VENV) || \
	  { echo "no venv module: apt install python3-venv, then make again"; exit 2; }
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,onnx,hf,poses,video,heic]'
	touch $@

clean:
	rm -rf $(VENV) build dist
