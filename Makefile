# make demo, make test and make test-slow work on a fresh clone with Python 3.10 to 3.12 and make alone: they create .venv and install everything.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: test test-slow test-viser1 soak torture demo bench lint format clean

.venv/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 10) <= v <= (3, 12) else f"Python 3.10 to 3.12 is needed, this is {v[0]}.{v[1]}; try: make PYTHON=python3.11 $(MAKECMDGOALS)")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet "uv>=0.5"
	VIRTUAL_ENV=$(CURDIR)/.venv $(BIN)/uv pip install --quiet -e ".[dev]"
	touch $@

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

test: lint
	$(BIN)/pytest -m "not slow"

test-slow: .venv/installed
	$(BIN)/pytest -m slow

# The viewer with viser 1.x, in an environment of its own
test-viser1: .venv/installed
	$(BIN)/pytest -m slow tests/browser/test_viser1.py

# A monkey before both viewers: make soak MINUTES=30 SEED=1
soak: .venv/installed
	NORMLIFT_SOAK=$(or $(MINUTES),30) NORMLIFT_SEED=$(or $(SEED),$$(date +%s)) $(BIN)/pytest -s -m slow tests/browser/test_monkey.py

torture: .venv/installed
	NORMLIFT_TORTURE=40 $(BIN)/pytest -m slow tests/torture

demo: .venv/installed
	$(BIN)/python -m normlift_ns.scripts.demo

bench: .venv/installed
	$(BIN)/python -m benchmarks.cpu
	$(BIN)/python -m benchmarks.forms

format: .venv/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist *.egg-info
