# `make help` lists the targets. Everything happens in .venv at the root of the checkout.

# The newest Python that pybullet has wheels for; override with `make train PYTHON=...`.
PYTHON ?= $(shell command -v python3.11 || command -v python3.10 || command -v python3)
# Installed before all that depends on torch, so that pip doesn't pick a build of its own choice.
TORCH ?= torch==2.13.0
ARGS ?=

BIN := .venv/bin
INSTALLED := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help install train evaluate view gallery test test-fast fuzz mutate schema lint types format bench bench-gpu smoke docs wheel clean check-python

help:  ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

check-python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v in ((3, 10), (3, 11)) else "flowrep needs CPython 3.10 or 3.11, because pybullet has wheels for no other (found %d.%d): try `make PYTHON=python3.11`" % v)'

$(INSTALLED): pyproject.toml | check-python
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $@

install: $(INSTALLED)  ## Create .venv and install flowrep into it

train: $(INSTALLED)  ## Train and evaluate an agent on Straight Road: make train ARGS="seed=1"
	$(BIN)/python -m flowrep.train preset=laptop $(ARGS)

evaluate: $(INSTALLED)  ## Evaluate a run: make evaluate ARGS="run=outputs/..."
	$(BIN)/python -m flowrep.evaluate $(ARGS)

smoke: $(INSTALLED)  ## A whole run in seconds
	$(BIN)/python -m flowrep.train debug=smoke $(ARGS)

view: $(INSTALLED)  ## Look at a scene: make view ARGS="scene=s_turn"
	$(BIN)/python -m flowrep.view $(ARGS)

SCENES = straight_road s_turn h_shaped_pathways three_way_junction

gallery: $(INSTALLED)  ## Make the README's gallery anew
	for scene in $(SCENES); do \
	  $(BIN)/python -m flowrep.view scene=$$scene sheet_rows=2 video=false hydra.run.dir=outputs/gallery/$$scene || exit 1; \
	  cp outputs/gallery/$$scene/sheet.png docs/images/gallery_$$scene.png; \
	  cp outputs/gallery/$$scene/plan.png docs/images/plan_$$scene.png; \
	done
	$(BIN)/python examples/filmstrip.py docs/images
	$(BIN)/python examples/transform_pictures.py docs/images/transforms

# A process a core, one thread each. A file stays in one process,
# since its tests share what they prepare.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses=auto --dist=loadfile

test: $(INSTALLED)  ## Run the tests
	$(PYTEST) $(ARGS)

test-fast: $(INSTALLED)  ## Run those that take no more than a second or two
	$(PYTEST) -m "not slow" $(ARGS)

fuzz: $(INSTALLED)  ## Throw odd inputs at every part: make fuzz ARGS="--parts scenes --mutations 10000"
	$(BIN)/python -m tests.fuzz $(ARGS)

mutate: $(INSTALLED)  ## Break the code here and there and see tests fail: make mutate ARGS="geometry --sample 60"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[mutate]"
	$(BIN)/python -m tests.mutate $(ARGS)

schema: $(INSTALLED)  ## Write the JSON schema of scene files that editors use
	$(BIN)/python -c 'from flowrep.scenes.schema import json_schema; print(json_schema(), end="")' > docs/scene.schema.json

lint: $(INSTALLED)  ## Check style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)  ## Check types
	$(BIN)/mypy

format: $(INSTALLED)  ## Mend style and formatting
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Those against ML-Agents need an environment of its own, those of a GPU a GPU.
BENCHMARKS = $(filter-out %mlagents.py %mlagents_worker.py benchmarks/gpu%,$(wildcard benchmarks/*.py))

bench: $(INSTALLED)  ## Run the benchmarks, one after the other
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[bench]"
	for script in $(BENCHMARKS); do echo "== $$script"; $(BIN)/python $$script || exit 1; done

bench-gpu: $(INSTALLED)  ## Measure everything on a GPU into outputs/gpu/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[bench]"
	$(BIN)/python benchmarks/gpu.py $(ARGS)

docs: $(INSTALLED)  ## Build the documentation into site/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[docs]"
	$(BIN)/zensical build --strict --clean

wheel: $(INSTALLED)  ## Build the wheel into dist/
	$(BIN)/python -m build --wheel

clean:  ## Remove .venv, builds and caches; never outputs/
	rm -rf .venv dist build site .pytest_cache .mypy_cache .ruff_cache
