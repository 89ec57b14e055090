"""Evaluates agents: `python -m flowrep.evaluate run=outputs/... speed=[low,high]`."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from flowrep.extras import require

require("evaluation", "train", "hydra", "pydantic", module=__name__)

from flowrep import pretrained
from flowrep.agent import CheckpointError
from flowrep.config import UsageError
from flowrep.config.cli import EXIT_USAGE, folder_name, print_error, run_command
from flowrep.config.schema import EvaluateConfig
from flowrep.envs import WorkerError
from flowrep.experiment import build
from flowrep.experiment.agents import Agent, PolicyError, load_external, load_trained
from flowrep.experiment.evaluation import (
    Comparison,
    evaluation_seeds,
    print_failures,
    print_table,
    save_drives,
    scene_id,
    write_failures,
)
from flowrep.experiment.film import record_episode
from flowrep.experiment.run import RunFolder
from flowrep.progress import StopRequest
from flowrep.scenes import load_scene

MISTAKES = (
    UsageError,
    CheckpointError,
    WorkerError,
    PolicyError,
    ValueError,
    ImportError,
    OSError,
)


class Target(NamedTuple):
    """An agent to evaluate: the folder of its table, how it is loaded, and its ways to act."""

    folder: RunFolder
    load: Callable[[], Agent]
    policies: Sequence[str]


def run(config: EvaluateConfig) -> None:
    """Runs episodes of agents and of baselines one agent after the other, and saves the rows.

    An agent whose folder is in use, or that can't be evaluated or saved, is reported and does not
    stop the others; the exit code is then 1. Baselines drive once in each scene.
    """
    targets = targets_of(config)
    comparisons: dict[str, Comparison] = {}
    failed: list[str] = []
    with StopRequest() as stop:
        for target in targets:
            try:
                with target.folder.held("evaluating"):
                    evaluate_one(config, target, comparisons, stop)
            except MISTAKES as error:
                if len(targets) == 1:
                    raise
                print_error(error)
                failed.append(str(target.folder.path))
            if stop:
                sys.exit(stop.exit_code)
    if failed:
        print_error(f"not evaluated or not saved, see above: {', '.join(failed)}")
        sys.exit(1 if len(failed) < len(targets) else EXIT_USAGE)


def targets_of(config: EvaluateConfig) -> list[Target]:
    """Returns the agents to evaluate: of runs and of sweeps, or policies of the user's own.

    Raises:
        RunFolderError: there is no run in one of the folders.
        UsageError: the folder for the rows of a policy of the user's own holds a run.
    """
    machine: dict[str, Any] = {
        "device": config.device,
        "num_envs": config.num_envs,
        "num_workers": config.num_workers,
    }
    if not config.own_policies:
        runs: dict[Path, RunFolder] = {}  # each once, under whatever names
        for path in config.run or []:
            for run in RunFolder.all_in(path):
                runs.setdefault(run.path.resolve(), run)
        load = partial(load_trained, scene=config.scene, **machine)
        return [Target(run, partial(load, run), config.policy) for run in runs.values()]
    targets = []
    for name in config.own_policies:
        folder = Path(config.output or f"outputs/evaluate/{folder_name(name)}")
        if (folder / "config.yaml").exists():
            raise UsageError(f"output={folder} is a run's folder; give another")
        load = partial(pretrained.load, config.scene or {}, **machine)
        load = (
            load
            if name == "pretrained"
            else partial(
                load_external,
                name,
                scene=config.scene or {},
                representations=config.representations or {},
                flow=None if config.flow is None else config.flow.plain(),
                motion=config.motion,
                noise=None if config.noise is None else config.noise.plain(),
                **machine,
            )
        )
        targets.append(Target(RunFolder(folder), load, [name]))
    return targets


def evaluate_one(
    config: EvaluateConfig, target: Target, comparisons: dict[str, Comparison], stop: StopRequest
) -> None:
    """Runs an agent's episodes, keeps finished ones even if interrupted, and films some."""
    agent, folder = target.load(), target.folder
    scene = load_scene(agent.config.scene)
    # agents of one scene share the baselines' episodes
    comparison = comparisons.setdefault(
        f"{scene_id(scene)} {target.policies}",
        Comparison(
            speeds=config.speed,
            fps=config.fps,
            episodes=config.episodes,
            seed=config.seed,
            policies=target.policies,
            baselines=config.baselines,
        ),
    )
    table = folder.read_episodes()
    num_envs = min(agent.config.num_envs, comparison.total)
    pool = build.evaluation_pool(agent.config, agent.policy, num_envs)

    def save() -> list[dict[str, Any]]:
        rows = comparison.rows(
            scene=scene.name,
            scene_id=scene_id(scene),
            representations="+".join(agent.config.representations),
            flow=agent.config.flow.source,
            seed=agent.config.seed if agent.frames else "",
            frames=agent.frames,
            evaluation="evaluate",
        )
        folder.save_episodes(rows, table)
        return rows

    def try_to_save() -> None:
        with suppress(OSError):  # the last time, it is reported
            save()

    try:
        comparison.run(
            agent.make_env, agent.policy, num_envs, lambda: bool(stop), try_to_save, pool
        )
    finally:
        if pool is not None:
            pool.close()
        if results := comparison.results():
            try:
                rows = save()
                save_drives(folder.drives_path, rows, [e.positions for _, e in results])
                folder.plot_episodes(rows)
                write_failures(folder.failures_path, folder.read_episodes())
            except OSError as error:
                raise OSError(
                    f"{folder.path}: {error}. Free some space or make the folder writable, then "
                    "evaluate again"
                ) from error
            print(folder.path)
            print_table(rows)
            print_failures(rows)
            print(f"{len(rows)} episodes are in {folder.evaluation_path}")
    film(config, agent, folder, stop)


def film(config: EvaluateConfig, agent: Agent, folder: RunFolder, stop: StopRequest) -> None:
    """Writes `video` episodes for each speed and frame rate, until a stop is asked for."""
    name = agent.config.scene["name"]
    where = "" if name == agent.trained_in else f"{name}_"
    conditions = product(config.speed, config.fps, range(config.video))
    for speed, rate, number in conditions:
        if stop:
            return
        (episode_seed,) = evaluation_seeds(config.seed + number, 1)
        path = folder.video_path(f"{where}{speed}_{rate:g}fps_{episode_seed}")
        make_env = partial(agent.make_env, speed=speed, frame_rate_hz=float(rate))
        seen = agent.config.representations
        record_episode(make_env, agent.policy, seen, path, episode_seed=episode_seed)
        print(f"video: {path}")


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that names the remedy."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
