import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
from concurrent.futures import ThreadPoolExecutor

import pytest

from flowrep.progress import StopRequest, progress_bar
from tests.running import run_python


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGUSR1, 138)],
    ids=["ctrl-c", "sigterm", "sighup", "slurm"],
)
def test_a_signal_asks_and_the_shell_gets_its_exit_code_until_earlier_handlers_are_back(
    number, code
):
    before = signal.getsignal(number)
    with StopRequest() as stop:
        assert not stop
        os.kill(os.getpid(), number)
        assert stop
        assert stop.exit_code == code
    assert signal.getsignal(number) is before


def test_a_hang_up_that_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("first", [[signal.SIGINT], [signal.SIGTERM, signal.SIGTERM]])
def test_a_ctrl_c_after_a_signal_ends_at_once_and_another_sigterm_does_not(first):
    with StopRequest() as stop:
        for number in first:
            os.kill(os.getpid(), number)
        assert stop.exit_code == 128 + first[0]
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


# What a bar writes into a file.


def test_in_a_log_a_line_comes_every_half_minute_also_of_a_bar_below_another(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr("flowrep.progress.time.monotonic", lambda: now[0])
    often = {"miniters": 0, "mininterval": 0}
    with progress_bar(what="training", desc=None, total=100, unit="frame", **often) as bar:
        bar.set_postfix_str("success 3%")
        for now[0] in range(1, 71):  # a second each
            bar.update()
        seconds = range(71, 111)
        for now[0] in progress_bar(seconds, what="evaluating", unit="episode", **often):
            pass
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("s, ")[0] for line in lines] == [
        "training: 30 of 100 frame", "training: 60 of 100 frame", "evaluating: 30 of 40 episode",
        "training: 70 of 100 frame",
    ]  # fmt: skip
    line = r"training: 60 of 100 frames, [\d.]+\w?frame/s, [\d:]+ left, success 3%"
    assert re.fullmatch(line, lines[1])


CHILDREN = """
import multiprocessing, os
from flowrep.progress import progress_bar

multiprocessing.set_start_method("spawn")  # as TorchRL does
for _ in progress_bar(range(3), what="counting"):
    pass
print(open(f"/proc/self/task/{os.getpid()}/children").read())
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="looks into /proc")
def test_a_bar_starts_no_process_that_a_hang_up_would_end():
    assert run_python("-c", CHILDREN, check=True).stdout == "\n"


HANGS_UP = """
import sys, time
from pathlib import Path
from flowrep.progress import progress_bar
from flowrep.progress import StopRequest

with StopRequest() as stop, progress_bar(what="x", total=9, mininterval=0, miniters=0) as bar:
    print("ready", flush=True)
    while not stop:
        bar.update(0)
        time.sleep(0.01)
    bar.update(1)
print("stopped; continue with ...", flush=True)
Path(sys.argv[1]).write_text(str(stop.exit_code))
"""


def test_a_closed_terminal_stops_as_sigterm_does_and_printing_to_it_is_no_error(tmp_path):
    saved, (end, terminal) = tmp_path / "saved", pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))

    def take():
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    streams = dict.fromkeys(("stdin", "stdout", "stderr"), terminal)
    command = [sys.executable, "-c", HANGS_UP, str(saved)]
    process = subprocess.Popen(command, **streams, preexec_fn=take)
    os.close(terminal)
    while b"ready" not in os.read(end, 4096):
        pass
    os.close(end)
    assert process.wait(timeout=60) == 0
    assert saved.read_text() == str(128 + signal.SIGHUP)


def test_in_another_thread_nothing_is_caught():
    def enters_and_leaves():
        with StopRequest() as stop:
            return not stop

    with ThreadPoolExecutor() as pool:
        assert pool.submit(enters_and_leaves).result()
