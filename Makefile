# SPDX-License-Identifier: Apache-2.0
# `make demo` and `make test` set up everything they need from a fresh clone, with plain venv and pip.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test check viewer-test player wheel wheel-test docs clean

demo: $(VENV)/.demo-ready
	$(BIN)/structgstream demo --output demo

test: $(VENV)/.test-ready
	scripts/check $(BIN)
	scripts/test $(BIN)
	scripts/viewer-test --if-node

check: $(VENV)/.test-ready
	scripts/check $(BIN)

# As in `make test`, which skips it where there is no Node 20 or newer; this fails there.
viewer-test:
	scripts/viewer-test

# The player that comes with the package, from viewer/packages; commit what changes.
player:
	scripts/build-player

# A plain (not editable) install: what is tested is what a user gets. Sources are listed so that a change reinstalls.
SOURCES := pyproject.toml CMakeLists.txt studies/pyproject.toml studies/README.md $(shell find csrc src studies/src -type f -not -path '*/__pycache__/*' -not -path '*/_native/*')

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo-ready: $(SOURCES) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[all]'
	touch $@

$(VENV)/.test-ready: $(SOURCES) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[dev]' ./studies
	touch $@ $(VENV)/.demo-ready

# A wheel in dist/ that runs on other machines, tried in an empty environment. WHEEL_OPTIONS: see scripts/wheel.
wheel:
	scripts/wheel --python $(PYTHON) $(WHEEL_OPTIONS)

# Only the trial of the wheel in dist/, with another Python for instance.
wheel-test:
	scripts/wheel --python $(PYTHON) --test-only $(WHEEL_OPTIONS)

# The documentation as a site, in site/.
docs:
	scripts/docs $(PYTHON)

clean:
	rm -rf $(VENV) .venv-wheel .venv-docs build dist site demo viewer/node_modules viewer/packages/*/dist viewer/packages/player/types viewer/packages/*/*.tsbuildinfo

# Tables of the documents, from the results beside them.
.PHONY: tables
tables: $(VENV)/.test-ready
	$(BIN)/python -m structgstream_studies.experiments results docs/ablations.md docs/compact.md docs/compact-measured.md docs/evaluation.md docs/method.md
