# Each command installs what it needs: demo what a user needs, test what a developer needs, the rest all.
PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(shell command -v uv >/dev/null && echo uv pip install --python $(BIN)/python || \
	echo $(BIN)/pip install --disable-pip-version-check --no-compile) --quiet --no-deps
COMPILE := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-annotate --no-header pyproject.toml
WORKSPACE ?= demo
WORKERS ?= 2
WORK ?= build/benchmarks
# Containers often forbid bytecode, which each program would compile again: 2 s of a processor for numpy and numba.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test test-slow test-all bench docs lint types imports structure lint-js check lock wheel clean

help:
	@echo "make demo    plan, fly, image, reconstruct and score a small survey into $(WORKSPACE)/"
	@echo "make test    run the tests of every day: 10 minutes on two busy cores, kernels compiled on the way"
	@echo "make test-all  run these and the slow ones: the loop, kills, docs, browser, fuzzing, Monte Carlo"
	@echo "make bench   run all benchmarks, for hours; table, logs and workspaces go into $(WORK)/"
	@echo "make docs    run the notebooks, for some minutes, and build the site of docs/ into build/site/"
	@echo "make wheel   build a wheel with its kernels, for this version of Python, into dist/"
	@echo "make check   lint (Python and JavaScript), types, import rules, and the bounds of make structure"
	@echo "make lock    renew locks/ from pyproject.toml: demo.lock, test.lock and all.lock"

# Each lock contains the one before it.
WITHIN_demo := demo
WITHIN_test := demo test
WITHIN_all := demo test all

.venv/%.ready: locks/%.lock pyproject.toml .ci/system-libraries
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: Python 3.11 or newer is needed; set PYTHON=/path/to/python3.11" >&2; exit 1; }
	@PYTHON=$(PYTHON) sh .ci/system-libraries
	[ -x $(BIN)/python ] || $(PYTHON) -m venv .venv
	$(INSTALL) --require-hashes -r $<
	$(INSTALL) --no-build-isolation -e .
	@touch $(WITHIN_$*:%=.venv/%.ready)

demo: .venv/demo.ready
	$(BIN)/alice-survey demo -w $(WORKSPACE)

test: .venv/test.ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m "not slow"

test-slow: .venv/all.ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m slow

test-all: .venv/all.ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup

bench: .venv/all.ready
	$(BIN)/python -m benchmarks --work $(WORK)

wheel: .venv/test.ready
	$(BIN)/python -m tests.build_wheel dist

docs: .venv/all.ready
	$(BIN)/python -m tests.docs.notebooks build/notebooks
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

lint: .venv/test.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/test.ready
	$(BIN)/mypy

imports: .venv/test.ready
	$(BIN)/lint-imports

structure: .venv/test.ready
	$(BIN)/python -m tests.structure

node_modules/.package-lock.json: package-lock.json
	npm ci --silent

lint-js: node_modules/.package-lock.json
	npm run --silent lint

check: lint types imports lint-js structure

lock: .venv/test.ready
	$(COMPILE) --extra slow -o locks/all.lock
	$(COMPILE) --extra dev -c locks/all.lock -o locks/test.lock
	$(COMPILE) --extra studio -c locks/all.lock -o locks/demo.lock

clean:
	rm -rf .venv demo
