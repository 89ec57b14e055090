"""A run's folder has one owner at a time, who is named."""

import json
import os
import platform
import signal
import subprocess
import sys

import pytest

from flowrep.experiment.folder_lock import FolderInUseError, folder_lock

HOLD = """
import sys, time
from pathlib import Path
from flowrep.experiment.folder_lock import folder_lock
with folder_lock(Path(sys.argv[1]), "training"):
    print("held", flush=True)
    time.sleep(100)
"""


def test_who_holds_a_folder_is_named_and_one_that_was_killed_holds_it_no_more(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout.readline() == b"held\n"
            message = rf"in use: process {other.pid} on {platform.node()} has been training in it "
            with pytest.raises(FolderInUseError, match=message + r"since \d{4}-\d\d-\d\d .*Wait"):
                folder_lock(tmp_path, "evaluating").__enter__()
        finally:
            other.kill()
    assert other.returncode == -signal.SIGKILL
    with folder_lock(tmp_path, "evaluating"):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()


def test_it_is_given_back_whatever_happens_in_it(tmp_path):
    with pytest.raises(ZeroDivisionError), folder_lock(tmp_path, "training"):
        raise ZeroDivisionError
    assert (tmp_path / ".lock").read_text() == ""
    with folder_lock(tmp_path, "training"), pytest.raises(FolderInUseError):
        folder_lock(tmp_path, "training").__enter__()


@pytest.mark.parametrize("text", ["", "half of {", "[1]", "{}"])
def test_a_holder_that_has_not_yet_written_who_it_is(tmp_path, text):
    with folder_lock(tmp_path, "training"):
        (tmp_path / ".lock").write_text(text)
        with pytest.raises(FolderInUseError, match="another process has just begun"):
            folder_lock(tmp_path, "training").__enter__()


def test_a_disk_without_locks_is_said_so_and_used(tmp_path, monkeypatch, capsys):
    def no_locks(*_):
        raise OSError(37, "No locks available")

    monkeypatch.setattr("flowrep.experiment.folder_lock.fcntl.flock", no_locks)
    with folder_lock(tmp_path, "training"):
        pass
    assert "no locks on the disk" in capsys.readouterr().err
