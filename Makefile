# Everything runs in a local virtual environment; PYTHON is any Python >= 3.11.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: optimize test test-all docs compat fuzz mutants lint weight clean

optimize: $(VENV)/.run
	$(BIN)/python -m rootsopt.optimize configs/cic.yaml -o results/cic

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not long"

# With programs that are optimised as for a user.
test-all: $(VENV)/.dev
	XLA_FLAGS=--xla_backend_optimization_level=3 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The site, in build/site; notebooks run if they or the code have changed. A warning is an error.
docs: $(VENV)/.dev
	$(BIN)/python -m sphinx -E -W --keep-going -b html -d build/trees docs build/site

# Oldest and newest supported versions of all dependencies, on each Python that is found (about ten
# minutes a job); PYTHONS='python3.12 /path/to/python3.13' chooses the interpreters.
PYTHONS ?= python3.11 python3.12 python3.13
compat: $(VENV)/.dev
	$(BIN)/python -m tests.compat --pythons $(PYTHONS)

# Thousands of random configs, outline files and environments (about an hour).
fuzz: $(VENV)/.dev
	$(BIN)/python -m pytest --hypothesis-profile=fuzz -k "random or damaged_files" \
	  tests/config/test_document.py tests/measured/test_outline_files.py
	$(BIN)/python -m pytest --hypothesis-profile=fuzz -k random tests/runtime/test_environment.py

# Mistakes put in on purpose, each to be noticed by a test (hours; goes on where it was stopped).
mutants: $(VENV)/.mutants
	$(BIN)/python -m tests.mutants --resume

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] + "; call make with PYTHON=python3.12, say" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.dev: $(VENV)/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

$(VENV)/.mutants: $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,mutants]'
	touch $@

# Statements, files, keys, words, and the limits that a test sets for them.
weight: $(VENV)/.dev
	$(BIN)/python -m tests.weight

clean:
	rm -rf $(VENV) results build
