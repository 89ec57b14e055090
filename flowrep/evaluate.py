"""Evaluates a trained agent: `python -m flowrep.evaluate run=outputs/... speed=[low,high]`."""

import sys
from functools import partial
from typing import Any

try:
    import hydra
except ImportError:
    sys.exit("error: evaluation needs packages of an extra: pip install 'flowrep[train]'")

from omegaconf import DictConfig, ListConfig

from flowrep.agent import Algorithm, CheckpointError, load_checkpoint
from flowrep.build import Config, build_agent, build_env
from flowrep.command_line import exit_with, own_keys, plain_config, run_command
from flowrep.config import UsageError, validated
from flowrep.config.evaluating import EvaluateConfig
from flowrep.config.training import validated_run
from flowrep.config_tree import CONF_DIR
from flowrep.experiment.comparison import compare, print_table, with_origin
from flowrep.experiment.failures import print_failures, write_failures
from flowrep.experiment.interruption import StopRequest
from flowrep.experiment.recording import record_episode
from flowrep.experiment.run_folder import RunFolder


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="evaluate")
def run(config: DictConfig) -> None:
    """Runs episodes of a saved agent and of baselines, prints a table and keeps the rows."""
    try:
        validated(EvaluateConfig, plain_config(config), own_keys())
        folder = RunFolder.existing(config.run)
        here = {key: config[key] for key in ("device", "num_envs", "num_workers")}
        trained = validated_run(folder.read_config(), f"{folder.path}/config.yaml") | here
        speeds, policies, baselines = (
            as_list(config[key]) for key in ("speed", "policy", "baselines")
        )
        rates = [float(rate) for rate in as_list(config.fps)]
        agent, frames = load_agent(trained, folder)
    except (UsageError, CheckpointError, ValueError, ImportError, OSError) as error:
        exit_with(str(error))
    with StopRequest() as stop:
        rows = compare(
            dict.fromkeys(policies, agent.policy),
            partial(build_env, trained),
            speeds=speeds,
            fps=rates,
            episodes=config.episodes,
            seed=config.seed,
            baselines=baselines,
            should_stop=lambda: bool(stop),
        )
        folder.log_episodes(with_origin(rows, trained, frames))
        print_table(rows)
        print_failures(rows)
        write_failures(folder.failures_path, folder.read_episodes())
        print(f"{len(rows)} episodes added to {folder.evaluation_path}")
        if not stop:
            film(agent, trained, folder, config, speeds, rates)


def as_list(value: Any) -> list[Any]:
    """Returns a list as it is, and a single value as a list of one."""
    return list(value) if isinstance(value, ListConfig) else [value]


def load_agent(trained: Config, folder: RunFolder) -> tuple[Algorithm, int]:
    """Returns the run's agent and the number of frames that it was trained for."""
    state = load_checkpoint(folder.checkpoint_path)
    env = build_env(trained, num_envs=1, num_workers=0)
    agent = build_agent(trained, env)
    env.close()
    agent.load_state_dict(state["agent"])
    return agent, state["frames"]


def film(
    agent: Algorithm,
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
                record_episode(make, agent.policy, seen, path, seed=config.seed + number)
                print(f"video: {path}")


def main() -> None:
    """Entry point; mistakes on the command line end in one line that lists what exists."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
