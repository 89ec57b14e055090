"""The console scripts `flowrep-train`, `flowrep-evaluate`, `flowrep-view`, `flowrep-factorize`."""

import sys
from importlib import import_module


def train() -> None:
    """Runs `flowrep.train`."""
    _run("train")


def evaluate() -> None:
    """Runs `flowrep.evaluate`."""
    _run("evaluate")


def view() -> None:
    """Runs `flowrep.view`."""
    _run("view")


def factorize() -> None:
    """Runs `flowrep.factorize`."""
    _run("factorize")


def _run(command: str) -> None:
    try:
        module = import_module(f"flowrep.{command}")
    except ImportError as error:
        sys.exit(f"error: {error}")
    module.main()
