"""A command line that is run up to its command."""

import sys

import pytest

from flowrep.config import cli
from tests.config.composing import schema_of


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs a command line up to the command; returns exit code, config and output."""

    def run(command, *arguments):
        found = []
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["flowrep-train", *arguments])
        code = 0
        try:
            cli.run_command(command, found.append, schema_of(command))
        except SystemExit as end:
            code = end.code
        return code, found, capsys.readouterr()

    return run
