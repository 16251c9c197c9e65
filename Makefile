# SPDX-License-Identifier: Apache-2.0
# `make demo` and `make test` set up everything they need from a fresh clone, with plain venv and pip.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test check python-test tables-test viewer-test player wheel wheel-test docs lab-test tables clean

demo: $(VENV)/.demo-ready
	$(BIN)/structgstream demo --output demo

# The first two parts run beside each other, and print when they end. The viewer's run alone: browsers play in real time.
test: $(VENV)/.test-ready
	@$(MAKE) --no-print-directory --jobs=$$(nproc 2> /dev/null || echo 1) --output-sync=target check python-test tables-test
	scripts/viewer-test --if-node

check: $(VENV)/.test-ready
	scripts/check $(BIN)

python-test: $(VENV)/.test-ready
	scripts/test $(BIN)

# The tables of the notes are those of the results beside them, and these of the present configurations.
tables-test: $(VENV)/.test-ready
	PYTHONPATH=lab/studies/src $(BIN)/python -m pytest -c lab/pytest.ini --rootdir . lab/tests/studies/experiments/test_documents.py lab/tests/studies/experiments/test_present.py

viewer-test:
	scripts/viewer-test

# The player that comes with the package, from viewer/packages; commit what changes.
player:
	scripts/build-player

# A plain (not editable) install: what is tested is what a user gets. Sources are listed so that a change reinstalls.
SOURCES := pyproject.toml CMakeLists.txt $(shell find csrc src -type f -not -path '*/__pycache__/*' -not -path '*/_native/*')

# Python compiles what is imported when it is first imported; compiling all that is installed takes a third of the time.
PIP_OPTIONS := --quiet --disable-pip-version-check --no-compile

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo-ready: $(SOURCES) | $(BIN)/python
	$(BIN)/python -m pip install $(PIP_OPTIONS) '.[all]'
	touch $@

$(VENV)/.test-ready: $(SOURCES) | $(BIN)/python
	$(BIN)/python -m pip install $(PIP_OPTIONS) '.[dev]'
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

# The laboratory (lab/README.md): studies and measurements that neither the package nor its tests know of.
$(VENV)/.lab-ready: $(VENV)/.test-ready $(shell find lab/studies -type f -not -path '*/__pycache__/*')
	$(BIN)/python -m pip install $(PIP_OPTIONS) ./lab/studies
	touch $@

lab-test: $(VENV)/.lab-ready
	scripts/lint $(BIN) lab
	$(BIN)/pyright --project lab --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-cache --config lab/studies/pyproject.toml
	$(BIN)/python -m pytest -c lab/pytest.ini --rootdir . lab/tests

# Tables of the notes, from the results beside them.
tables: $(VENV)/.lab-ready
	$(BIN)/python -m structgstream_studies.experiments lab/results lab/notes/ablations.md lab/notes/compact.md lab/notes/compact-measured.md lab/notes/evaluation.md lab/notes/method.md
