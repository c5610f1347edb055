# Two commands do all the set-up they need: make demo, make test.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
WORKSPACE ?= demo
WORKERS ?= 2
WORK ?= build/benchmarks

.PHONY: help setup demo test test-slow test-all bench docs lint types imports structure lint-js check lock clean

help:
	@echo "make demo    plan, fly, image, reconstruct and score a small survey into $(WORKSPACE)/"
	@echo "make test    run the tests of every day: about 10 minutes on two idle cores"
	@echo "make test-all  run these and the slow ones: the loop, kills, docs, browser, fuzzing, Monte Carlo"
	@echo "make bench   run all benchmarks, for hours; table, logs and workspaces go into $(WORK)/"
	@echo "make docs    build the site of docs/ into build/site/"
	@echo "make check   lint (Python and JavaScript), types, import rules, and the bounds of make structure"
	@echo "make lock    renew requirements.lock from pyproject.toml"

setup: $(READY)

$(READY): requirements.lock pyproject.toml .ci/system-libraries
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: Python 3.11 or newer is needed; set PYTHON=/path/to/python3.11" >&2; exit 1; }
	@PYTHON=$(PYTHON) sh .ci/system-libraries
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(READY)
	$(BIN)/alice-survey demo -w $(WORKSPACE)

test: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m "not slow"

test-slow: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m slow

test-all: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup

bench: $(READY)
	$(BIN)/python -m benchmarks --work $(WORK)

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

imports: $(READY)
	$(BIN)/lint-imports

structure: $(READY)
	$(BIN)/python -m tests.structure

node_modules/.package-lock.json: package-lock.json
	npm ci --silent

lint-js: node_modules/.package-lock.json
	npm run --silent lint

check: lint types imports lint-js structure

lock: $(READY)
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --extra dev --extra docs --extra bench \
		--generate-hashes --no-emit-index-url --no-annotate --no-header pyproject.toml -o requirements.lock

clean:
	rm -rf .venv demo
