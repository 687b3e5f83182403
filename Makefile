# Two commands do everything on a fresh machine: `make calibrate` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# Many containers forbid Python to keep what it has compiled, so that every process of ours compiles again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: env calibrate test verify docs lint format lock clean

env: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; this is $$($(PYTHON) --version). Try: make PYTHON=python3.12"; exit 2; }
	@echo "first time: making $(VENV) and installing $$(grep -c '==' requirements.lock) packages into it; a few minutes, once"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	$(BIN)/python -m compileall -q agent drivers fake_controller second_world
	$(BIN)/python -c 'from agent.compiled import *'
	@touch $(STAMP)
	@echo "$(VENV) is ready"

calibrate: env
	@$(BIN)/python recipes/quickstart.py

lint: env
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

test: env lint
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not verify"

verify: env
	$(BIN)/python tests/verify.py

docs: env
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "build/site/index.html; its search needs a server: $(BIN)/python -m http.server -d build/site"

format: env
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock: env
	$(BIN)/pip-compile --quiet --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-annotate \
		--no-header --strip-extras --extra dev --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV)
