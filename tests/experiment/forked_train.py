"""`python -m flowrep.train resume=...` many times over: imported once, forked for each command.

Reads one JSON object a line and answers with one. A request is

    {"run": folder, "kill_after_s": 0.3, "kill_at": ["rename", 2], "largest_file": 100000}

of which all but the first may be missing; the answer holds the exit code (minus the signal's number
for a command that was killed) and what was printed.
"""

import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

# what a run would import late
import matplotlib.pyplot  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

import flowrep.train
from flowrep import files
from flowrep.agent import checkpoint
from flowrep.experiment.run import RunFolder
from flowrep.experiment.schema import validated_run


def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)


def half_a_file(tensors, file, **_):
    Path(file).write_bytes(bytes(1000))
    die()


def killed_at(stage: str, save: int) -> None:
    """Arranges that the process kills itself in that stage of writing its nth checkpoint."""
    write, rename = (checkpoint, "save_file"), (os, "replace")
    steps = {"write": write, "half": write, "flush": (files, "_flush")}
    (module, name), left = steps.get(stage, rename), [save]
    whole = getattr(module, name)

    def counted(*arguments, **options):
        left[0] -= any(str(each).endswith(".safetensors") for each in arguments)
        if left[0]:
            return whole(*arguments, **options)
        if stage == "renamed":
            whole(*arguments, **options)
        return half_a_file(*arguments) if stage == "half" else die()

    setattr(module, name, counted)


def child(request: dict, output) -> None:
    """Runs the command and ends the process as it would."""
    code = 0
    os.dup2(output.fileno(), 1)
    os.dup2(output.fileno(), 2)
    try:
        if "kill_at" in request:
            killed_at(*request["kill_at"])
        if "largest_file" in request:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (request["largest_file"],) * 2)
        folder = RunFolder.existing(request["run"])
        config = validated_run(folder.read_config(), "config.yaml")
        flowrep.train.finish(config.model_copy(update={"resume": request["run"]}), folder)
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def answer(request: dict) -> dict:
    """Runs one command in a process of its own; kills it when its time is over."""
    # Appended to and read by its name: what the command leaves behind (multiprocessing's resource
    # tracker, with a last warning) may still write, and would move a shared position.
    with tempfile.NamedTemporaryFile("a") as output:
        pid = os.fork()
        if not pid:
            child(request, output)
        if "kill_after_s" in request:
            time.sleep(request["kill_after_s"])
            os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        printed = Path(output.name).read_text(encoding="utf-8")
        return {"code": os.waitstatus_to_exitcode(status), "printed": printed}


if __name__ == "__main__":
    print("ready", flush=True)
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), flush=True)
