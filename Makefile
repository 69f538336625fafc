# Every target is enough by itself on a bare Debian 12 or Ubuntu machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow lint setup clean

demo: setup
	$(BIN)/morgs-mi demo out/demo

test: setup
	$(BIN)/pytest

test-slow: setup
	$(BIN)/pytest -m "slow and not gpu"

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

# LLVM is asked for every time: it lives outside the environment and costs 50 ms to find.
setup: $(STAMP)
	@tools/setup_llvm.sh $(BIN)/python

$(STAMP): pyproject.toml constraints.txt tools/setup_venv.sh
	tools/setup_venv.sh $(PYTHON) $(VENV)
	@touch $@

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
