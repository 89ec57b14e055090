"""Starts and ends flowrep's commands; has the console scripts `flowrep-train` and so on."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
    prepare()
    try:
        module = import_module(f"flowrep.{command}")
    except ImportError as error:
        sys.exit(f"error: {error}")
    module.main()


def prepare() -> None:
    """Prepares the process for the imports of a command, which take seconds.

    Ctrl-C ends it at once, since libraries mistake an exception during their imports for another
    one. Standard streams that the caller closed go to the null device; otherwise the next opened
    file would take their place. Characters that they can't encode are replaced. Output is flushed
    after each line, also to a pipe.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="replace", line_buffering=True)  # type: ignore[union-attr]


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Makes Ctrl-C and SIGTERM raise `SystemExit`, so that open resources are closed.

    A second signal ends the process at once. A signal that the caller ignores stays ignored.
    """
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, _: FrameType | None) -> NoReturn:
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_DFL)
    sys.exit(128 + number)


def end_when_unread() -> None:
    """Makes the process end silently at the first print to a pipe that is no longer read.

    Nothing is closed, so this is for commands that only print.
    """
    if hasattr(signal, "SIGPIPE"):  # not on Windows
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)


def exit_unread() -> NoReturn:
    """Ends the process silently when its output is no longer read, as after `| head -1`."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):  # flushing them at exit would print an error
        os.dup2(nowhere, stream.fileno())
    sys.exit(128 + signal.SIGPIPE)
