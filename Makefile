# Two commands on a fresh machine with python3, python3-venv, libglib2.0-0 and make:
#   make demo     makes its own environment, installs, runs the demo
#   make test     the same for the tests
#   make deb      a Debian package of it in build/; for a board with ARM: make deb ARCH=arm64
# and: make test-quick (without processes and long drives, for the inner loop: a minute on two cores),
#      make check (format, lint, types), make docs (the generated parts of docs/; the site in build/site), make bench (ratio benchmarks), make clean,
#      make screenshots (of the viewer, for the docs).

PYTHON ?= python3
VENV   ?= .venv
# Which tests `make test` runs; empty: all of them.
TESTS  ?=
BIN    := $(VENV)/bin
# A changed pyproject.toml installs again; a failed install leaves no stamp behind.
RUN_STAMP := $(VENV)/.installed-run
DEV_STAMP := $(VENV)/.installed-dev
DOCS_STAMP := $(VENV)/.installed-docs
DEB_STAMP := $(VENV)/.installed-deb

.PHONY: demo deb test test-quick check format screenshots docs bench types clean help

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | head -7

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "ModelServer needs Python 3.11 or later; choose one with: make PYTHON=/path/to/python3.11 ..." >&2; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "python3-venv is missing: sudo apt install python3-venv" >&2; exit 2; }
	@$(PYTHON) -c 'import ctypes; ctypes.CDLL("libglib-2.0.so.0")' 2>/dev/null || \
	  { echo "libglib-2.0, which LCM needs, is missing: sudo apt install libglib2.0-0" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(RUN_STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[report]'
	@touch $@

$(DEV_STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $(RUN_STAMP) $@

$(DOCS_STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $(RUN_STAMP) $@

$(DEB_STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[bags,foxglove,report,view]'
	@touch $(RUN_STAMP) $@

demo: $(RUN_STAMP)
	$(BIN)/modelserver demo

deb: $(DEB_STAMP)
	$(BIN)/python tools/debian_package.py $(if $(ARCH),--arch $(ARCH))

test: $(DEV_STAMP)
	$(BIN)/python -m pytest -n auto $(TESTS)

test-quick: $(DEV_STAMP)
	$(BIN)/python -m pytest -n "$$(nproc)" -m "not slow" tests/unit tests/contract tests/property

check: $(DEV_STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(DEV_STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

screenshots: $(DEV_STAMP)
	$(BIN)/python tests/make_screenshots.py

# The variable silences an announcement of the theme about a later mkdocs; it is no warning about these pages.
docs: $(DOCS_STAMP)
	$(BIN)/python tools/docs_pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

types: $(DEV_STAMP)
	$(BIN)/python tools/generate_types.py

bench: $(DEV_STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,bench]'
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
