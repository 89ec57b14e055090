"""`python -m flowrep.train resume=...` in processes that are forked, so that one has imported all.

The tests kill these at a chosen instant.
"""

import json
import os
import resource
import signal
import sys
import traceback
from pathlib import Path

# what a run would import late
import matplotlib.pyplot  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

import flowrep.train
from flowrep import files
from flowrep.agent import checkpoint
from flowrep.envs import StreetEnv
from flowrep.experiment.run import RunFolder
from flowrep.experiment.schema import validated_run

# what a run would load late, too: compiled code, once a street is drawn
STREET = StreetEnv("straight_road")
STREET.reset(seed=0)


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


def carry_on(run, printed, kill_at=None, largest_file=None):
    """Continues a run and ends the process as the command would; `printed` gets what it prints."""
    code = 0
    with open(printed, "a") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    try:
        if kill_at:
            killed_at(*kill_at)
        if largest_file:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        folder = RunFolder.existing(run)
        config = validated_run(folder.read_config(), "config.yaml")
        flowrep.train.run_in_folder(config.model_copy(update={"resume": str(run)}), folder)
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


if __name__ == "__main__":
    # Forks a process for each line of arguments, and says its number, then its exit code.
    for line in sys.stdin:
        if not (child := os.fork()):
            carry_on(**json.loads(line))
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
