"""Python in a process of its own, commands in this one, and the names that docs explain."""

import importlib
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def run_python(*arguments, env=ENVIRONMENT, **options):
    """Runs Python on this checkout, with one thread, and returns how it ended and what it said."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=env, **options)


def run_here(monkeypatch, command):
    """Runs `python -m flowrep.train ...` or `python file.py ...` in this process; returns its code.

    Nothing has to be imported again, which takes a command seconds.
    """
    name, *arguments = [word for word in command[1:] if word != "-m"]
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    try:
        if name.endswith(".py"):
            runpy.run_path(name, run_name="__main__")
        else:
            module = f"{name}.__main__" if name == "flowrep.report" else name
            importlib.import_module(module).main()
    except SystemExit as ended:
        return ended.code or 0
    return 0


def glossary():
    """Returns the names that the page of metrics explains."""
    page = ROOT / "docs" / "metrics.md"
    return {*re.findall(r"`(\w+)`", page.read_text(encoding="utf-8"))}
