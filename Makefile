# Two commands do everything on a fresh machine: `make calibrate` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# Many containers forbid Python to keep what it has compiled, so that every process of ours compiles again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: env dev calibrate test pytest ros verify docs lint format lock package release clean

env: $(VENV)/.user
dev: $(VENV)/.dev

# What `make calibrate` needs.
$(VENV)/.user: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; this is $$($(PYTHON) --version). Try: make PYTHON=python3.12"; exit 2; }
	@echo "first time: making $(VENV) and installing $$(grep -c '==' requirements.lock) packages into it; a minute or two"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --requirement requirements.lock
	$(INSTALL) --no-deps --editable .
	$(BIN)/python -m compileall -q agent drivers fake_controller second_world
	$(BIN)/python -c 'from agent.compiled import *'
	@touch $@

# The rest: the extras, tests, checks and the documentation.
$(VENV)/.dev: $(VENV)/.user requirements-dev.lock
	@echo "adding what tests and documentation need: $$(grep -c '==' requirements-dev.lock) packages in all"
	$(INSTALL) --no-compile --requirement requirements-dev.lock
	@touch $@

calibrate: env
	@$(BIN)/python recipes/quickstart.py

lint: dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

# Side by side: types are checked by one process, and many tests wait for a watchdog rather than compute.
test: dev
	@$(MAKE) --no-print-directory --jobs 2 lint pytest

pytest: dev
	$(BIN)/python -m pytest -n 4 --dist worksteal -m "not verify and not alone"
	$(BIN)/python -m pytest -m "not verify and alone" tests/faults

# ROS 2 has an environment of its own (250 MB): its wheels restart every Python that they are installed for.
ROS := .venv-ros
$(ROS)/.made: $(VENV)/.dev
	$(PYTHON) -m venv $(ROS)
	$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check \
		'ros-jazzy-rclpy[fastrtps]' ros-jazzy-sensor-msgs ros-jazzy-trajectory-msgs
	-$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check cyclonedds  # no wheel for some
	$(BIN)/python -c 'import site; print("import site; site.addsitedir(%r)" % site.getsitepackages()[0])' \
		> "$$($(ROS)/bin/python -c 'import site; print(site.getsitepackages()[0])')/zz_project.pth"
	printf '#!/bin/sh\nexec "$${0%%/*}/python" -m agent "$$@"\n' > $(ROS)/bin/agent && chmod +x $(ROS)/bin/agent
	@touch $@

ros: $(ROS)/.made
	$(ROS)/bin/python -m pytest -n 4 --dist worksteal -m "not verify" tests/ros2 tests/link/test_watch.py

verify: dev
	$(BIN)/python tests/verify.py

docs: dev
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "build/site/index.html; its search needs a server: $(BIN)/python -m http.server -d build/site"

format: dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Both locks agree: the second takes the versions of the first. Neither names an address of an index.
LOCK := $(BIN)/pip-compile --quiet --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-annotate \
	--no-header --strip-extras --unsafe-package calibration-agent --unsafe-package pip --unsafe-package setuptools \
	pyproject.toml --output-file
lock: dev
	$(LOCK) requirements.lock
	$(LOCK) requirements-dev.lock --extra dev --constraint requirements.lock

# The wheel and the archive of the sources, checked.
package: env
	rm -rf build/lib build/package
	$(INSTALL) build twine
	$(BIN)/python -m build --outdir build/package
	$(BIN)/twine check --strict build/package/*

# Checks, builds and tags the version in pyproject.toml; publishing is left to a person.
VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
release: dev
	@test -z "$$(git status --porcelain)" || { echo "commit or remove your changes first: git status"; exit 2; }
	@grep -q '^## $(VERSION)$$' CHANGELOG.md || { echo "CHANGELOG.md has no section '## $(VERSION)'"; exit 2; }
	@grep -q '^version: $(VERSION)$$' CITATION.cff || { echo "CITATION.cff names another version than $(VERSION)"; exit 2; }
	@! git rev-parse -q --verify refs/tags/v$(VERSION) > /dev/null || { echo "v$(VERSION) is tagged already"; exit 2; }
	$(MAKE) test package
	git tag --annotate v$(VERSION) --message "Version $(VERSION)"
	@echo "tagged v$(VERSION); build/package holds what can be published"

clean:
	rm -rf $(VENV)
