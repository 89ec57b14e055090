"""A command line that is run up to its command."""

import sys

import pytest

from flowrep.config import cli
from flowrep.experiment import schema
from flowrep.factorize import FactorizeConfig
from flowrep.report.__main__ import ReportConfig

SCHEMAS = {
    "train": schema.TrainConfig,
    "evaluate": schema.EvaluateConfig,
    "factorize": FactorizeConfig,
    "report": ReportConfig,
    "view": schema.ViewConfig,
}


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs a command line up to the command; returns exit code, config and output."""

    def run(command, *arguments):
        found = []
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["flowrep-train", *arguments])
        code = 0
        try:
            cli.run_command(command, found.append, SCHEMAS[command])
        except SystemExit as end:
            code = end.code
        return code, found, capsys.readouterr()

    return run
