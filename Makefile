# Two verbs are all a newcomer needs: `make run` and `make test`.
PYTHON ?= python3
OUT ?= results
BIN := .venv/bin

.PHONY: run quick test check docs bench clean
.DELETE_ON_ERROR:

run: .venv/installed
	$(BIN)/armperturb study --out $(OUT)

test: .venv/installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

# The tests that are not marked slow.
quick: .venv/installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m "not slow"

check: .venv/installed-test .venv/installed-check docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Into site/. While writing, `.venv/bin/mkdocs serve` shows each change at once.
docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -W error -m mkdocs build --strict

bench: .venv/installed-test
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv site $(OUT)

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "armperturb needs Python 3.11 or newer, this is " + sys.version)'
	$(PYTHON) -m venv .venv

# One stamp per set of packages, so that a second call installs nothing.
.venv/installed: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

.venv/installed-test: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test]'
	touch $@ .venv/installed

.venv/installed-check: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[check]'
	touch $@

.venv/installed-docs: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	touch $@
