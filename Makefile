# `make help` lists the targets. Everything happens in .venv at the root of the checkout.

# Override with `make train PYTHON=...`.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3.14 || command -v python3)
# Installed before all that depends on torch, so that pip doesn't pick a build of its own choice.
# On Linux the default is CUDA's build, 6.6 GB with all that .venv holds; BACKEND=cpu has uv choose
# the CPU's, 2.2 GB. INDEX names another index, such as a mirror.
TORCH ?= torch==2.13.0
BACKEND ?=
INDEX ?=
ARGS ?=

ENV := .venv
BIN := $(ENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
INSTALLED := $(ENV)/.installed
DEVELOPED := $(ENV)/.developed

.DEFAULT_GOAL := help
.PHONY: help install develop demo train evaluate view results gallery test test-fast test-python test-lowest schema lint types format bench bench-gpu smoke docs wheel clean check-python

help:  ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

check-python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else "flowrep needs Python 3.11 or newer (found %d.%d): try `make PYTHON=python3.13`" % v)'

$(INSTALLED): pyproject.toml | check-python
	@echo "Installing PyTorch into $(ENV) (a minute or two) ..."
	@$(PYTHON) -m venv $(ENV)
	@$(if $(BACKEND),$(PIP) uv && $(BIN)/uv pip install --quiet --python $(ENV) --torch-backend=$(BACKEND),$(PIP) $(if $(INDEX),--index-url $(INDEX))) "$(TORCH)"
	@echo "Installing flowrep and what training, reports and recordings need ..."
	@$(PIP) --editable ".[train,report,factorize]"
	@touch $@

$(DEVELOPED): $(INSTALLED)
	@echo "Installing what the tests need ..."
	@$(PIP) --editable ".[dev]"
	@touch $@

install: $(INSTALLED)  ## Create .venv and install flowrep into it; without a GPU: make install BACKEND=cpu

develop: $(DEVELOPED)  ## Install what tests, lint and types need, too

train: $(INSTALLED)  ## Train and evaluate an agent on Straight Road: make train ARGS="seed=1"
	$(BIN)/python -m flowrep.train preset=laptop $(ARGS)

evaluate: $(INSTALLED)  ## Evaluate a run: make evaluate ARGS="run=outputs/..."
	$(BIN)/python -m flowrep.evaluate $(ARGS)

smoke: $(INSTALLED)  ## A whole run in about half a minute, too short to learn anything
	$(BIN)/python -m flowrep.train debug=smoke $(ARGS)

demo: $(INSTALLED)  ## A trained agent drives 20 episodes, the first as a film: make demo ARGS="scene=s_turn"
	$(BIN)/python -m flowrep.view policy=pretrained episodes=20 $(ARGS)

view: $(INSTALLED)  ## Look at a scene: make view ARGS="scene=s_turn"
	$(BIN)/python -m flowrep.view $(ARGS)

results: $(INSTALLED)  ## Make paper/results.md and its figures from the stored runs
	$(BIN)/python -m paper.results

SCENES = straight_road s_turn h_shaped_pathways three_way_junction

gallery: $(INSTALLED)  ## Redraw the pictures of the documentation
	for scene in $(SCENES); do \
	  $(BIN)/python -m flowrep.view scene=$$scene sheet_rows=2 video=false output=outputs/gallery/$$scene || exit 1; \
	  cp outputs/gallery/$$scene/sheet.png docs/images/gallery_$$scene.png; \
	  cp outputs/gallery/$$scene/plan.png docs/images/plan_$$scene.png; \
	done
	$(BIN)/python -m docs.pictures docs/images

# A process a core, one thread each. Each starts with its half of the files, whose tests share what
# they prepare, and takes over some of another's at the end; tests/conftest.py puts long ones first.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses=auto --dist=worksteal

test: $(DEVELOPED)  ## Run the tests
	$(PYTEST) $(ARGS)

test-fast: $(DEVELOPED)  ## Run the fast tests only
	$(PYTEST) -m "not slow" $(ARGS)

test-python:  ## Run the fast tests with the newest packages, on another Python: make test-python PYTHON=python3.14
	$(MAKE) test-fast ENV=.venv-$(notdir $(PYTHON)) TORCH=torch

# uv can choose the oldest versions, pip can't. Without a GPU: make test-lowest UV_TORCH_BACKEND=cpu
test-lowest: $(DEVELOPED)  ## Run the fast tests with the oldest packages that pyproject.toml admits
	$(BIN)/uv venv --quiet --allow-existing --python 3.11 .venv-lowest
	$(BIN)/uv pip install --quiet --python .venv-lowest --resolution lowest-direct --editable ".[dev]"
	@touch .venv-lowest/.installed .venv-lowest/.developed
	$(MAKE) test-fast ENV=.venv-lowest

schema: $(INSTALLED)  ## Write what editors say about the keys of scene files
	$(BIN)/python -m docs.scene_keys

lint: $(DEVELOPED)  ## Check style, formatting and spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell

types: $(DEVELOPED)  ## Check types
	$(BIN)/mypy

format: $(DEVELOPED)  ## Fix style and formatting
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(INSTALLED)  ## Run the benchmarks, one after the other
	$(PIP) --editable ".[bench]"
	for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

bench-gpu: $(INSTALLED)  ## Measure updates, factorising flow, envs and a short training on a GPU
	$(PIP) --editable ".[bench]"
	$(BIN)/python benchmarks/update.py --device cuda --rounds 20
	$(BIN)/python benchmarks/factorize.py --device cuda
	$(BIN)/python benchmarks/frames.py --device cuda --scenes straight_road --sizes 84 --workers 0 1 4 8 16
	$(BIN)/python benchmarks/training.py --alone --rounds 1 --frames 20_000 preset=paper device=cuda

docs: $(INSTALLED)  ## Build the documentation into site/
	$(PIP) --editable ".[docs]"
	$(BIN)/zensical build --strict --clean

wheel: $(DEVELOPED)  ## Build the wheel into dist/
	$(BIN)/python -m build --wheel

clean:  ## Remove .venv, builds and caches; never outputs/
	rm -rf .venv .venv-* dist build site .pytest_cache .mypy_cache .ruff_cache
