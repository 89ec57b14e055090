"""Evaluates agents: `python -m flowrep.evaluate run=outputs/... 'speed=[low,high]'`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from flowrep.extras import require

require("evaluation", "train", "hydra", "pydantic", module=__name__)

from flowrep.config import UsageError
from flowrep.config.cli import EXIT_USAGE, folder_name, is_a_mistake, print_error, run_command
from flowrep.config.schema import EvaluateConfig
from flowrep.progress import StopRequest

if TYPE_CHECKING:
    from flowrep.experiment.agents import Agent
    from flowrep.experiment.evaluation import Comparison
    from flowrep.experiment.run import RunFolder


class Target(NamedTuple):
    """An agent to evaluate: the folder of its table, how it is loaded, and its ways to act."""

    folder: RunFolder
    load: Callable[[], Agent]
    policies: Sequence[str]


def run(config: EvaluateConfig) -> None:
    """Runs episodes of agents and baselines, one agent after the other, and saves the rows.

    A folder in use, or an agent that can't be evaluated or saved, is reported and does not stop the
    others; the exit code is then 1. Baselines drive once in each scene.
    """
    from flowrep.agent import keep_freed_memory

    keep_freed_memory()
    targets = targets_of(config)
    comparisons: dict[str, Comparison] = {}
    failed: list[str] = []
    with StopRequest() as stop:
        for target in targets:
            try:
                with target.folder.held("evaluating"):
                    evaluate_one(config, target, comparisons, stop)
            except Exception as error:
                if len(targets) == 1 or not is_a_mistake(error):
                    raise
                print_error(error)
                failed.append(str(target.folder.path))
            if stop:
                sys.exit(stop.exit_code)
    if failed:
        print_error(f"not evaluated or not saved, see above: {', '.join(failed)}")
        sys.exit(1 if len(failed) < len(targets) else EXIT_USAGE)


def targets_of(config: EvaluateConfig) -> list[Target]:
    """Returns the agents to evaluate: of runs and of sweeps, or policies of the user's own."""
    from flowrep.experiment.agents import load_trained
    from flowrep.experiment.run import RunFolder
    from flowrep.policies import load_agent

    machine = config.model_dump(include={"device", "num_envs", "num_workers"})
    if not config.own_policies:
        runs: dict[Path, RunFolder] = {}  # each once, under whatever names
        for path in config.run or []:
            for run in RunFolder.all_in(path):
                runs.setdefault(run.path.resolve(), run)
        trusted = config.algorithm.target
        load = partial(load_trained, scene=config.scene, algorithm=trusted, **machine)
        return [Target(run, partial(load, run), config.policy) for run in runs.values()]
    keys = ("scene", "representations", "flow", "motion", "noise")
    seen = {key: getattr(config, key) for key in keys}
    targets = []
    for name in config.own_policies:
        folder = Path(config.output or f"outputs/evaluate/{folder_name(name)}")
        if (folder / "config.yaml").exists():
            raise UsageError(f"output={folder} is a run's folder; give another")
        load = partial(load_agent, name, **seen, **machine)
        targets.append(Target(RunFolder(folder), load, [name]))
    return targets


def evaluate_one(
    config: EvaluateConfig, target: Target, comparisons: dict[str, Comparison], stop: StopRequest
) -> None:
    """Runs an agent's episodes, keeps finished ones even if interrupted, and films some."""
    from flowrep.experiment import build
    from flowrep.experiment.evaluation import Comparison, print_results

    agent, folder = target.load(), target.folder
    if not config.own_policies:  # whose networks may be large
        build.share_cores(agent.config)
    origin = agent.origin("evaluate")
    # agents of one scene share the baselines' episodes
    episodes = config.speed, config.fps, config.episodes, config.seed
    comparison = comparisons.setdefault(
        f"{origin['scene_id']} {target.policies}",
        Comparison(*episodes, target.policies, config.baselines),
    )
    table = folder.read_episodes()
    num_envs = agent.config.num_envs

    def try_to_save() -> None:
        with suppress(OSError):  # the last time, it is reported
            folder.save_episodes(comparison.rows(**origin), table)

    try:
        comparison.run(agent.make_env, agent.policy, num_envs, stop=stop, save=try_to_save)
    finally:
        if rows := comparison.rows(**origin):
            try:
                positions = [episode.positions for _, episode in comparison.results()]
                folder.log_episodes(rows, positions, table)
                folder.write_failures()
            except OSError as error:
                raise OSError(
                    f"{folder.path}: {error}. Free some space or make the folder writable, then "
                    "evaluate again"
                ) from error
            print(folder.path)
            if whole := comparison.rows(only_whole=True, **origin):
                print_results(whole)
            if len(whole) < len(rows):
                print(
                    f"{len(rows) - len(whole)} episodes are of a policy, speed and frame rate that "
                    "lack others. Short episodes end first: compare them after the same command "
                    "has run to its end"
                )
            print(f"{len(rows)} of {comparison.total} episodes are in {folder.evaluation_path}")
    film(config, agent, folder, stop)


def film(config: EvaluateConfig, agent: Agent, folder: RunFolder, stop: StopRequest) -> None:
    """Writes `video` episodes for each speed and frame rate, until a stop is asked for."""
    from flowrep.experiment.film import record_episode

    name = agent.config.scene["name"]
    where = "" if name == agent.trained_in else f"{name}_"
    for speed, rate, number in product(config.speed, config.fps, range(config.video)):
        if stop:
            return
        seed = config.seed + number
        path = folder.video_path(f"{where}{speed}_{rate:g}fps_{seed}")
        record_episode(agent, path, episode_seed=seed, speed=speed, frame_rate_hz=float(rate))
        print(f"video: {path}")


def main() -> None:
    """Entry point."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
