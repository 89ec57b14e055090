"""However a command is begun or ended: it works or says one line, and leaves nothing behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SMALL = [
    "debug=smoke", "device=cpu", "num_workers=2", "total_frames=32", "evaluation.every_frames=0",
    "evaluation.final_episodes=1", "evaluation.speeds=[high]", "evaluation.baselines=[]",
    "evaluation.video=false", "scene.time_limit_steps=10",
]  # fmt: skip
ENDLESS = ["total_frames=1000000", "log_every_frames=16", "checkpoint_every_frames=1000000"]
IN_PROC = pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="looks into /proc")


@pytest.fixture
def train(tmp_path, short_folder):
    """Starts `flowrep.train`; afterwards none of its processes and folders may be left."""
    begun = []
    temporary = short_folder

    def start(*arguments, environment=None, closed=(), **options):
        def as_in_a_terminal():
            listen_to_signals()
            for number in closed:
                os.close(number)

        options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": tmp_path} | options
        changes = {"OMP_NUM_THREADS": "1", "TMPDIR": str(temporary), **(environment or {})}
        changed = {name: text for name, text in (os.environ | changes).items() if text is not None}
        command = [sys.executable, "-m", "flowrep.train", *arguments]
        begun.append(
            subprocess.Popen(
                command, env=changed, preexec_fn=as_in_a_terminal, start_new_session=True, **options
            )
        )
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.wait()
        wait_until(lambda process=process: not processes_of(process.pid))
    assert not [path.name for path in temporary.glob("pymp-*")]


def listen_to_signals():
    """Undoes what a shell does to those that it starts in the background."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def processes_of(session):
    """Returns the processes of a session that run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of_session = stat.read_text().rsplit(")", 1)[1].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(of_session) == session and state not in "ZX":
            found.append(int(stat.parent.name))
    return found


def wait_until(holds, seconds=300):
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@IN_PROC
@pytest.mark.slow
def test_a_reader_that_goes_ends_it_quietly_and_odd_surroundings_do_not_matter(tmp_path, train):
    """The first run is `| head -1`; the second goes on with what the first has saved."""
    run = tmp_path / "josé" / "run"
    odd = {"LC_ALL": "C", "HOME": None, "TMPDIR": "/proc", "PYTHONUNBUFFERED": None}
    surroundings = {"environment": odd, "closed": [0]}
    first = train(*SMALL, f"hydra.run.dir='{run}'", **surroundings)
    assert first.stdout.readline().decode() == f"run folder: {run}\n"
    first.stdout.close()
    said = first.stderr.read().decode()
    assert first.wait() == 128 + signal.SIGPIPE, said
    for word in ("error", "Error", "Traceback", "space"):
        assert word not in said
    second = train(f"resume={run}", "device=cpu", "num_workers=0", **surroundings)
    printed, said = second.communicate()
    assert second.returncode == 0, said.decode()
    assert "greedy" in printed.decode()
    assert (run / "evaluation.csv").exists()


@IN_PROC
@pytest.mark.slow
def test_two_ctrl_c_in_a_row_end_it_without_a_trace(tmp_path, train):
    process = train(*SMALL, *ENDLESS, f"hydra.run.dir={tmp_path}/run")
    wait_until((tmp_path / "run" / "metrics.csv").exists)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate()[1].decode()
    # by the first alone, if it was quick; by the second, while it saved; or by one more at its end
    assert process.returncode in (130, -signal.SIGINT)
    assert "Traceback" not in said
    assert "rror" not in said


@IN_PROC
@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGKILL, -9), (signal.SIGTERM, 143)], ids=["kill", "sigterm"]
)
def test_a_start_that_is_cut_short_leaves_no_workers(tmp_path, train, number, code):
    """While the server of the workers is begun, or imports what they need."""
    process = train(*SMALL, f"hydra.run.dir={tmp_path}/run", stdout=subprocess.DEVNULL)
    wait_until(lambda: len(processes_of(process.pid)) >= 3)  # with the tracker of resources
    if number == signal.SIGKILL:
        process.kill()
    else:
        os.killpg(process.pid, number)
    said = process.communicate()[1].decode()
    assert process.returncode == code
    if number != signal.SIGKILL:  # a worker that is begun just then may say that its caller is gone
        assert "Traceback" not in said


@IN_PROC
def test_ctrl_c_during_the_imports_ends_it_at_once(train):
    process = train("--cfg", "job", stdout=subprocess.DEVNULL)
    maps = Path(f"/proc/{process.pid}/maps")
    wait_until(lambda: "libtorch" in maps.read_text())
    process.send_signal(signal.SIGINT)
    assert process.communicate()[1] == b""
    assert process.returncode == -signal.SIGINT


def python(code, **options):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, **options)


def test_closed_streams_lead_nowhere_and_not_into_the_next_file(tmp_path):
    code = (
        "from flowrep.console import prepare; prepare()\n"
        f"file = open({str(tmp_path / 'file')!r}, 'w')\n"
        "import os, sys; print('out'); os.write(1, b'by number'); print('err', file=sys.stderr)\n"
        "assert sys.stdin.read() == ''; assert file.fileno() > 2\n"
    )
    done = python(code, preexec_fn=lambda: os.closerange(0, 3))
    assert done.returncode == 0
    assert (tmp_path / "file").read_text() == ""


def test_what_a_terminal_cannot_show_is_replaced():
    code = "from flowrep.console import prepare; prepare(); print('josé →')"
    done = python(code, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stdout, done.stderr) == (0, "jos? ?\n", "")


CLOSING = """
import os, signal
from flowrep.console import ended_by_signals
try:
    with ended_by_signals():
        os.kill(os.getpid(), signal.{first})
        print("was not ended")
finally:
    print("closed", flush=True)
    {meanwhile}
"""


@pytest.mark.parametrize("first", ["SIGINT", "SIGTERM"])
def test_a_signal_closes_what_is_open_and_one_more_ends_it_at_once(first):
    done = python(CLOSING.format(first=first, meanwhile="pass"), preexec_fn=listen_to_signals)
    assert (done.returncode, done.stdout) == (128 + getattr(signal, first), "closed\n")
    code = CLOSING.format(first=first, meanwhile="os.kill(os.getpid(), signal.SIGTERM)")
    done = python(code, preexec_fn=listen_to_signals)
    assert (done.returncode, done.stdout) == (-signal.SIGTERM, "closed\n")


def test_what_the_caller_ignores_stays_ignored():
    code = (
        "import os, signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from flowrep.console import ended_by_signals, prepare; prepare()\n"
        "with ended_by_signals(): os.kill(os.getpid(), signal.SIGINT); print('goes on')"
    )
    assert python(code).stdout == "goes on\n"
