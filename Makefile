# Two verbs are all a newcomer needs: `make run` and `make test`.
PYTHON ?= python3
OUT ?= results
BIN := .venv/bin
LATEST := .venv-latest/bin
# A file's tests share a process, and with it what they are made from; tests/conftest.py puts the long files first.
PYTEST := -m pytest -n auto --dist loadfile --no-loadscope-reorder
# Bytecode is left to the first import: to make that of everything doubles the time of an installation.
INSTALL := -m pip install --quiet --no-compile -c
export OMP_NUM_THREADS ?= 1
# Without bytecode every process that a test starts would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run quick test test-core test-latest check docs tutorials bench clean
.DELETE_ON_ERROR:

run: .venv/installed
	$(BIN)/armperturb study --out $(OUT)

# The tests that are not marked slow.
quick: .venv/installed-test
	$(BIN)/python $(PYTEST) -m "not slow"

test: .venv/installed-test
	$(BIN)/python $(PYTEST)

# The core alone: no simulator, no compiler.
test-core: .venv-core/installed
	rm -rf .venv-core/results && mkdir .venv-core/results
	.venv-core/bin/python tests/core.py .venv-core/results

# The newest MuJoCo, which dm_control does not allow: its recordings and environments are those of the usual one.
test-latest: .venv/installed-test .venv-latest/installed
	$(BIN)/python tests/digests.py > .venv-latest/digests.json
	ARMPERTURB_DIGESTS=.venv-latest/digests.json $(LATEST)/python $(PYTEST) tests/envs/test_digests.py tests/models \
	  tests/controllers tests/planar_arm tests/envs/lab tests/envs/learning

check: .venv/installed-test .venv/installed-check docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Into site/. While writing, `.venv/bin/mkdocs serve` shows each change at once.
docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -W error -m mkdocs build --strict

# Runs the tutorials in examples/, and writes their pages, pictures and notebooks.
tutorials: .venv/installed-test
	$(BIN)/python docs/tutorials/make.py

bench: .venv/installed-test
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv .venv-core .venv-latest site $(OUT)

%/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "armperturb needs Python 3.11 or newer, this is " + sys.version)'
	$(PYTHON) -m venv $*

# One stamp per set of packages, so that a second call installs nothing. Machine code is compiled once, here.
.venv/installed: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python $(INSTALL) constraints.txt -e '.[sim]'
	$(BIN)/python -m armperturb.study.results.compiling
	touch $@

.venv/installed-test: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python $(INSTALL) constraints.txt -e '.[test,dm]'
	$(BIN)/python -m armperturb.study.results.compiling
	touch $@ .venv/installed

.venv/installed-check: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python $(INSTALL) constraints.txt -e '.[check]'
	touch $@

.venv/installed-docs: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python $(INSTALL) constraints.txt -e '.[docs]'
	touch $@

# fontTools, which embeds fonts in PDFs, takes 4 MB in Python, and 22 MB compiled.
.venv-core/installed: .venv-core/bin/python pyproject.toml constraints.txt
	.venv-core/bin/python -m pip install --quiet -c constraints.txt --no-binary fonttools -e .
	touch $@

.venv-latest/installed: .venv-latest/bin/python pyproject.toml constraints.txt constraints-latest.txt
	sed '/^mujoco==/d' constraints.txt > .venv-latest/constraints.txt
	$(LATEST)/python $(INSTALL) .venv-latest/constraints.txt -c constraints-latest.txt -e '.[learn]' pytest pytest-xdist
	touch $@
