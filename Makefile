# Every target sets up what it needs on a bare Debian 12 or Ubuntu machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Two processes, each with a file at a time: tests of one file share their fixtures.
PYTEST := $(BIN)/pytest -n 2 --dist loadfile
WEB_PLAYER ?= morgs_mi/playback/export/web_player
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow test-long lint docs web wheel setup clean

demo: setup
	$(BIN)/morgs-mi demo out/demo

test: setup
	$(PYTEST)

test-slow: setup
	$(PYTEST) -m "slow and not gpu"

test-long: setup
	$(BIN)/pytest -m "long and not gpu"

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/python tools/check_dialect.py morgs_mi benchmarks examples scenes tests tools
	$(BIN)/pyright
	$(BIN)/typos

docs: setup
	$(BIN)/sphinx-build -q -W --keep-going docs docs/_build/html
	@echo "Documentation: docs/_build/html/index.html"

# Needs Node.js 20 or newer. The result is part of the repository, so nothing else does.
web:
	cd web && npm ci --no-audit --no-fund && npm run build -- "$(abspath $(WEB_PLAYER))"

# sdist and wheel in dist/; the wheel is installed and checked in a new environment outside of the checkout.
wheel: setup
	tools/check_wheel.sh $(BIN)/python

# LLVM is checked every time: it is outside the environment, and finding it takes 50 ms.
setup: $(STAMP)
	@tools/setup_llvm.sh $(BIN)/python
	@$(if $(filter setup,$(MAKECMDGOALS)),echo "Ready: make demo",:)

$(STAMP): pyproject.toml constraints.txt tools/setup_venv.sh
	@tools/setup_venv.sh $(PYTHON) $(VENV)
	@touch $@

clean:
	rm -rf $(VENV) out build dist web/node_modules *.egg-info .pytest_cache .ruff_cache docs/_build docs/notebooks docs/api/*_*.md
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
