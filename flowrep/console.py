"""The console scripts: `flowrep-train` and its like do what `python -m flowrep.train` does."""

import sys
from importlib import import_module


def train() -> None:
    """Runs `flowrep.train`."""
    _run("train")


def evaluate() -> None:
    """Runs `flowrep.evaluate`."""
    _run("evaluate")


def export() -> None:
    """Runs `flowrep.export`."""
    _run("export")


def view() -> None:
    """Runs `flowrep.view`."""
    _run("view")


def factorize() -> None:
    """Runs `flowrep.factorize`."""
    _run("factorize")


def report() -> None:
    """Runs `flowrep.report`."""
    _run("report.command")


def _run(command: str) -> None:
    try:
        module = import_module(f"flowrep.{command}")
    except ImportError as error:
        sys.exit(f"error: {error}")
    module.main()
