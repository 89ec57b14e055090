"""Trains an agent: `python -m flowrep.train 'representations=[ego,obj]' preset=laptop`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

import json
import re
import sys
from contextlib import closing
from typing import TYPE_CHECKING, Any

from flowrep.extras import require

require("training", "train", "hydra", "pydantic", "imageio_ffmpeg", module=__name__)

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from flowrep import sweep
from flowrep.config.cli import checked, end_with, exit_with, line_for, run_command
from flowrep.config.options import validated
from flowrep.config.run_names import OF_THE_MACHINE, settings_of
from flowrep.config.usage import UsageError
from flowrep.experiment.outcomes import is_finished
from flowrep.experiment.schema import TrainConfig
from flowrep.progress import StopRequest

if TYPE_CHECKING:
    from flowrep.experiment.run import RunFolder
    from flowrep.experiment.runner import Runner

PATIENCE_S = 60.0  # a process that received a stop signal may still be saving the run


class EarlyCheck(Callback):
    """Checks a config before Hydra makes the run's folder; conf/run_folder.yaml adds it."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Ends the process if the config is wrong."""
        try:
            model = checked(config, TrainConfig)
            if model.resume is None:
                from flowrep.experiment import build

                build.resolved(model)
        except Exception as error:  # Hydra would print a warning and go on
            end_with(error)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Ends the process if two runs of a sweep would share a folder."""
        try:
            sweep.check_folders_differ(config.hydra)
        except Exception as error:
            end_with(error)


def run(config: TrainConfig) -> None:
    """Trains, evaluates and films one agent, or continues a run with `resume=`."""
    from flowrep.experiment.run import RunFolder

    job = HydraConfig.get()
    if config.resume is not None:
        folder = RunFolder.existing(config.resume)
        with folder.locked(PATIENCE_S):
            run_in_folder(resumed(config, folder, list(job.overrides.task)), folder)
        return
    folder = RunFolder(job.runtime.output_dir)
    with folder.locked():
        folder.check_is_new()
        announce(config, settings_of(job.runtime.choices))
        run_in_folder(config, folder)


def run_sweep_job() -> None:
    """Begins or resumes the run that `sweep.job` describes on stdin, and has checked."""
    from flowrep.experiment.run import RunFolder

    try:
        asked = json.load(sys.stdin)
        config, folder = validated(TrainConfig, asked["config"]), RunFolder(asked["folder"])
        with folder.locked(PATIENCE_S):
            if folder.config_path.is_file():
                machine = {key: getattr(config, key) for key in OF_THE_MACHINE}
                stored = folder.config(config.trusted)
                config = stored.model_copy(update=machine | {"resume": str(folder.path)})
            else:
                folder.check_is_new()
                announce(config, asked["settings"])
            run_in_folder(config, folder)
    except Exception as error:
        end_with(error)


def resumed(config: TrainConfig, folder: RunFolder, typed: list[str]) -> TrainConfig:
    """Returns the config of the run to resume, with the changes that are allowed."""
    typed = [text.lstrip("+") for text in typed if not text.startswith("resume=")]
    given = [text.partition("=")[0] for text in typed]
    trusted = "algorithm._target_"
    classes = [k for k in given if re.fullmatch(r"(algorithm|representations\.\w+)\._target_", k)]
    stored = folder.config(config.trusted if classes else ())
    # What the weights depend on is stored. Only the machine and the length may change.
    allowed = (*OF_THE_MACHINE, "total_frames", trusted)
    if others := [key for key in given if key not in (*allowed, *classes)]:
        raise UsageError(
            f"resume= continues a run with its stored config, so '{others[0]}=' would be ignored: "
            f"leave it out ({', '.join(allowed)} may be given)"
        )
    if trusted in given and stored.algorithm.target != config.algorithm.target:
        raise UsageError(
            f"the run in '{folder.path}' is of {trusted}={stored.algorithm.target}: leave out "
            f"{trusted}={config.algorithm.target}, or start a new run with it"
        )
    frames = config.total_frames if "total_frames" in given else stored.total_frames
    if frames < stored.total_frames:
        raise UsageError(
            f"total_frames={frames} is less than the run's {stored.total_frames}: a run can be "
            "made longer, not shorter"
        )
    changes = {key: getattr(config, key) for key in given if key not in classes}
    return stored.model_copy(update=changes | {"resume": str(folder.path)})


def announce(config: TrainConfig, settings: str) -> None:
    """Prints what is trained on which device, and on a CPU how long the paper's settings take."""
    import torch

    from flowrep.envs.torchrl_env import usable_device
    from flowrep.envs.workers import available_cores
    from flowrep.experiment.provenance import cpu_name

    device = usable_device(config.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()
    cores = f", {available_cores()} cores" if device.type == "cpu" else ""
    maps, algorithm = ",".join(config.representations), config.algorithm.target.rpartition(".")[2]
    print(f"{algorithm} on [{maps}] in {config.scene.name}, {settings}")
    print(f"device: {device.type} ({where}{cores})")
    asked = config.evaluation
    print(
        f"evaluation.episodes={asked.episodes} every {asked.every_frames:,} frames; at the end "
        f"evaluation.final_episodes={asked.final_episodes} for each speed, frame rate and policy"
    )
    if settings == "preset=paper" and device.type == "cpu" and config.total_frames >= 1_000_000:
        print(
            f"{config.total_frames:,} frames with the paper's settings take about a day a map; "
            "preset=laptop takes minutes"
        )


def run_in_folder(config: TrainConfig, folder: RunFolder) -> None:
    """Runs what remains of a run: training, evaluation, film.

    Its config is written once everything could be built: what fails before leaves no run behind.
    """
    from flowrep.agent import CheckpointError, DivergenceError
    from flowrep.envs import WorkerError
    from flowrep.experiment import build
    from flowrep.experiment.runner import Runner

    config = build.resolved(config)
    how_to_go_on = line_for("train", resume=str(folder.path))
    with StopRequest() as stop, closing(Runner(config, folder)) as runner:
        if config.resume is None:
            folder.write_config(config.plain())
        else:
            runner.load()
            folder.write_total_frames(config.total_frames)
        print(f"run folder: {folder.path}")
        try:
            is_evaluated = train_evaluate_film(runner, stop)
        except (CheckpointError, DivergenceError, WorkerError, OSError) as error:
            may_go_on = not isinstance(error, DivergenceError)
            exit_with(
                f"after {runner.frames} frames: {error}",
                f"Continue with: {how_to_go_on}" if may_go_on else "",
            )
    if stop and not is_evaluated:
        print(f"\nstopped after {runner.frames} frames; the run is saved. Continue with")
        print(f"  {how_to_go_on}")
        sys.exit(stop.exit_code)


def train_evaluate_film(runner: Runner, stop: StopRequest) -> bool:
    """Trains and evaluates, unless that is done already; returns whether all is done."""
    config, folder = runner.config, runner.folder
    if is_finished(folder.path, config):
        how = line_for("evaluate", run=str(folder.path))
        print(f"this run is complete; evaluate it with: {how}")
    else:
        runner.train(stop)
        if stop or not runner.evaluate("final", stop):
            return False
        print(f"wall time: {runner.clock.summary()}")
    runner.film()
    return True


def main() -> None:
    """Entry point."""
    if sweep.is_sweep(sys.argv[1:]):
        sweep.run_sweep()
    run_command("train", run, TrainConfig)


if __name__ == "__main__":
    main()
