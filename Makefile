# Set-up happens by itself: each target first brings .venv up to date with pyproject.toml and constraints.txt.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

.PHONY: help train demo fleet chromium test bench check format docs build clean
help:  ## Show this help
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/'

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "error: Python 3.11 is needed (PyBullet has no wheels for later ones): make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 2; }
	@echo "==> Creating $(VENV)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "==> Installing physai into $(VENV)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[mujoco,onnx,web]'
	@touch $@

$(VENV)/.installed-ros: $(VENV)/.installed
	@echo "==> Installing ROS 2 Jazzy into $(VENV)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[mujoco,onnx,ros,web]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	@echo "==> Installing the tools for the documentation into $(VENV)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs,mujoco,onnx,ros,web]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "==> Installing the tools for tests and benchmarks into $(VENV)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,bench,docs,foxglove,joblib,mlflow,mujoco,onnx,optuna,ray,ray-launcher,ros,submitit,wandb,web]'
	@touch $@

train: $(VENV)/.installed  ## Train the two-link arm (ARGS="env=kuka_reacher seed=1" for more)
	@echo "==> Training"
	$(BIN)/python -m physai.train env=reacher $(ARGS)

demo: $(VENV)/.installed-ros  ## Let the newest policy drive a virtual robot over ROS 2 (ARGS="randomization=strong")
	@echo "==> Driving"
	$(BIN)/python -m physai.ros.demo $(ARGS)

fleet: $(VENV)/.installed-ros  ## Let the newest policies drive eight virtual robots over ROS 2, with a page (ARGS="arms=4")
	@echo "==> Driving a fleet"
	$(BIN)/python -m physai.ros.fleet render=web $(ARGS)

chromium:
	@command -v chromium > /dev/null || { test "$$(id -u)" = 0 || \
	  { echo "error: the tests open pages in Chromium: apt-get install chromium, then make test"; exit 2; }; \
	  echo "==> Installing Chromium, in which the tests open pages" && apt-get update -qq -o Acquire::Retries=3 && \
	  DEBIAN_FRONTEND=noninteractive apt-get install -qq -o Acquire::Retries=3 --yes --no-install-recommends chromium > /dev/null; }

# The quick tests are one part: none of them measures time. A part of which ARGS choose no test (pytest's exit code 5) is
# no failure. Who keeps Python from storing what it compiles pays for it in each of the many processes here.
# On two cores, a fourth worker that computes makes all of them slower; of those that wait, four are best.
test: export PYTHONDONTWRITEBYTECODE =
test: $(VENV)/.installed-dev chromium  ## Run all tests (ARGS="-m 'not slow'" for the quick ones)
	@export PHYSAI_TEST_RUNS=$$(mktemp -d); trap 'rm -rf "$$PHYSAI_TEST_RUNS"' EXIT; \
	part() { echo "==> Testing $$1"; shift; $(BIN)/python -m pytest "$$@" $(ARGS) || [ $$? = 5 ]; }; \
	if [ -n "$(findstring not slow,$(ARGS))" ]; then part "what is quick" -n 3 --dist worksteal --realtime=without; exit; fi; \
	part "what is not ROS" -n 3 --dist worksteal --ignore tests/ros --realtime=without && \
	part "ROS 2 nodes, which mostly wait, side by side" tests/ros -n 4 --dist worksteal --realtime=without && \
	part "what measures time, four at a time and nothing else" tests/ros tests/bench -n 4 --dist worksteal --realtime=only

bench: $(VENV)/.installed-dev  ## Measure speed against bare PyBullet, rclpy and Stable-Baselines3
	@echo "==> Measuring (all of it takes several hours; ARGS=--collection and the like choose a part)"
	$(BIN)/python -m physai.bench $(ARGS)

check: $(VENV)/.installed-dev  ## Check format, lint, types and the direction of imports
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.installed-dev  ## Format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(VENV)/.installed-docs  ## Build the documentation's site into build/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict $(ARGS)
	@echo "==> The site: build/docs/index.html"

build: $(VENV)/.installed-dev  ## Build a wheel and try it in an empty environment, from another folder
	rm -rf dist build/wheel-test
	$(BIN)/python -m build --wheel
	$(PYTHON) -m venv build/wheel-test
	build/wheel-test/bin/python -m pip install --quiet --constraint constraints.txt dist/*.whl
	cd / && $(CURDIR)/build/wheel-test/bin/python -m physai.train --help > /dev/null
	@echo "==> The wheel works: $$(ls dist/*.whl)"

clean:  ## Remove what make created (not outputs/)
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
