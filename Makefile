# make demo, make test and make test-slow work on a fresh clone with Python 3.10 to 3.12 and make alone: they create .venv and install everything.
PYTHON ?= python3
BIN := .venv/bin
# Files of tests are shared among so many processes; one after the other: make test WORKERS=0
WORKERS ?= 2
# Tests start hundreds of processes: what one compiles, the next reads, also where the environment forbids it
export PYTHONDONTWRITEBYTECODE :=
BESIDE := -n $(WORKERS) --dist worksteal

.PHONY: check style quick-tests test test-slow test-all test-versions soak torture demo docs bench lint format clean

# Compiles the kernels of the CPU rasterizer that no cache holds, which takes half a minute for each precision
KERNELS = import torch; from normlift_ns.rasterization.numba import compile_kernels; compile_kernels(torch.float32, torch.float64).join()

.venv/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 10) <= v <= (3, 12) else f"Python 3.10 to 3.12 is needed, this is {v[0]}.{v[1]}; try: make PYTHON=python3.11 $(MAKECMDGOALS)")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet "uv>=0.5"
	VIRTUAL_ENV=$(CURDIR)/.venv $(BIN)/uv pip install --quiet --compile-bytecode -e ".[dev]"
	$(BIN)/python -W ignore -c "$(KERNELS)"
	touch $@

STYLE := $(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/codespell && $(BIN)/python -m tests.prose

style: .venv/installed
	$(STYLE)

lint: style
	$(BIN)/pyrefly check

# The inner loop: style, types, and the fastest tests of the core
check: lint quick-tests

QUICK := $(patsubst %,tests/core/test_%.py,lift relevancy neighbors gaussians metrics validation)
quick-tests: .venv/installed
	$(BIN)/pytest -q $(BESIDE) -m "not slow and not extra" $(QUICK) tests/test_imports.py

# Style and types are checked while the tests run
test: .venv/installed
	@{ $(STYLE) && $(BIN)/pyrefly check; } > .venv/checks.log 2>&1 & checks=$$!; \
	$(BIN)/pytest $(BESIDE) $(JUNIT) -m "not slow and not extra" --ignore=tests/browser --ignore=tests/torture; tests=$$?; \
	wait $$checks; checks=$$?; cat .venv/checks.log; exit $$((tests + checks))

# A browser and the viewer that it shows fill two cores: their tests run after the rest, one at a time
test-slow: .venv/installed
	$(BIN)/pytest $(BESIDE) $(JUNIT) -m "slow and not extra" --ignore=tests/browser
	$(BIN)/pytest -m "slow and not extra" tests/browser

# The core and the commands, for other versions of Python
test-versions: .venv/installed
	$(BIN)/pytest $(BESIDE) -m "not slow and not extra" tests/core tests/cli

# Before a release: everything, with twenty times the examples
test-all: lint
	NORMLIFT_EXAMPLES=20 NORMLIFT_TORTURE=40 $(BIN)/pytest $(BESIDE) $(JUNIT) --ignore=tests/browser
	$(BIN)/pytest tests/browser --ignore=tests/browser/test_monkey.py
	$(MAKE) soak

# A monkey before both viewers: make soak MINUTES=30 SEED=1
soak: .venv/installed
	NORMLIFT_SOAK=$(or $(MINUTES),30) NORMLIFT_SEED=$(or $(SEED),$$(date +%s)) $(BIN)/pytest -s -m extra tests/browser/test_monkey.py

torture: .venv/installed
	NORMLIFT_TORTURE=40 $(BIN)/pytest tests/torture

demo: .venv/installed
	$(BIN)/python -m normlift_ns.cli.demo

docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: .venv/installed
	$(BIN)/python -m research.cpu
	$(BIN)/python -m research.forms

format: .venv/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist *.egg-info
