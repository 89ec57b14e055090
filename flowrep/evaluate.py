"""Evaluates a trained agent: `python -m flowrep.evaluate run=outputs/... speed=[low,high]`."""

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

from flowrep.extras import require

require("evaluation", "train", "hydra", "pydantic", module=__name__)

import hydra
from omegaconf import DictConfig, ListConfig

from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.build import Config, build_env, build_policy
from flowrep.command_line import exit_with, own_keys, plain_config, run_command
from flowrep.config import UsageError, validated
from flowrep.config.evaluating import EvaluateConfig
from flowrep.config.training import validated_run
from flowrep.config_tree import CONF_DIR
from flowrep.envs import WorkerError
from flowrep.experiment.comparison import compare, print_table, with_origin
from flowrep.experiment.evaluation import Policy
from flowrep.experiment.failures import print_failures, write_failures
from flowrep.experiment.interruption import StopRequest
from flowrep.experiment.origin import check_origin, origin_of
from flowrep.experiment.recording import record_episode
from flowrep.experiment.run_folder import RunFolder

OF_THE_MACHINE = ("device", "num_envs", "num_workers", "trust")  # not as the run was trained


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="evaluate")
def run(config: DictConfig) -> None:
    """Runs episodes of a saved agent and of baselines, prints a table and keeps the rows."""
    try:
        validated(EvaluateConfig, plain_config(config), own_keys())
        folder = RunFolder.existing(config.run)
        with folder.held("evaluating"):
            evaluate(config, folder)
    except (UsageError, CheckpointError, WorkerError, ValueError, ImportError, OSError) as error:
        exit_with(str(error))


def evaluate(config: DictConfig, folder: RunFolder) -> None:
    """Does what `run` says, for an agent in a folder that is held."""
    own = validated_run(folder.read_config(), f"{folder.path}/config.yaml")
    trained = own | {key: config[key] for key in OF_THE_MACHINE}
    speeds, policies, baselines = (as_list(config[key]) for key in ("speed", "policy", "baselines"))
    rates = [float(rate) for rate in as_list(config.fps)]
    folder.read_episodes()  # a table that can't be added to is better known before than after
    policy, frames = load_policy(trained, folder, origin_of(own))
    with StopRequest() as stop:
        rows = compare(
            dict.fromkeys(policies, policy),
            partial(build_env, trained),
            speeds=speeds,
            fps=rates,
            episodes=config.episodes,
            seed=config.seed,
            baselines=baselines,
            should_stop=lambda: bool(stop),
        )
        print_table(rows)
        print_failures(rows)
        folder.log_episodes(with_origin(rows, trained, frames, "evaluate"))
        write_failures(folder.failures_path, folder.read_episodes())
        print(f"{len(rows)} episodes are in {folder.evaluation_path}")
        if not stop:
            film(policy, trained, folder, config, speeds, rates)
    if stop:
        sys.exit(stop.exit_code)


def as_list(value: Any) -> list[Any]:
    """Returns a list as it is, and a single value as a list of one."""
    return list(value) if isinstance(value, ListConfig) else [value]


def load_policy(
    trained: Config, folder: RunFolder, origin: Mapping[str, Any]
) -> tuple[Policy, int]:
    """Returns the run's policy and the number of frames that it was trained for.

    Raises:
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
    """
    path = folder.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin, path)
    env = build_env(trained, num_envs=1, num_workers=0)
    policy = build_policy(trained, env, trust=trained["trust"])
    env.close()
    policy.load_state_dict(state["policy"])
    return policy, state["frames"]


def film(
    policy: Policy,
    trained: Config,
    folder: RunFolder,
    config: DictConfig,
    speeds: list[str],
    rates: list[float],
) -> None:
    """Writes `video` episodes for each speed and frame rate."""
    for speed in speeds:
        for rate in rates:
            for number in range(config.video):
                path = folder.video_path(f"{speed}_{rate:g}fps_{number}")
                make = partial(build_env, trained, speed=speed, frame_rate_hz=rate)
                seen = trained["representations"]
                record_episode(make, policy, seen, path, seed=config.seed + number)
                print(f"video: {path}")


def main() -> None:
    """Entry point; mistakes on the command line end in one line that lists what exists."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
