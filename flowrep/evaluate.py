"""Evaluates agents: `python -m flowrep.evaluate run=outputs/... speed=[low,high]`."""

import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from flowrep.console import prepare
from flowrep.extras import require

if __name__ == "__main__":
    prepare()
require("evaluation", "train", "hydra", "pydantic", module=__name__)

import hydra
import torch
from omegaconf import DictConfig
from torchrl.data import Composite

from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.config import UsageError, validated
from flowrep.config.command_line import (
    exit_with,
    folder_name,
    own_keys,
    plain_config,
    run_command,
)
from flowrep.config.evaluating import EvaluateConfig
from flowrep.config.training import validated_run
from flowrep.config.violations import shown
from flowrep.config_tree import CONF_DIR
from flowrep.envs import WorkerError, street_envs
from flowrep.exchange.cards import check_card
from flowrep.exchange.policies import ForeignPolicy, PolicyError, Task, is_reference, load_policy
from flowrep.experiment.arena import Agent
from flowrep.experiment.comparison import Comparison, Row, print_table, with_origin
from flowrep.experiment.failures import print_failures, write_failures
from flowrep.experiment.interruption import StopRequest
from flowrep.experiment.origin import check_origin, differences, origin_of
from flowrep.experiment.run_folder import RunFolder
from flowrep.from_config import (
    Config,
    arena_from_config,
    choose_device,
    env_from_config,
    policy_from_config,
)
from flowrep.viz.film import record_episode

MISTAKES = (
    UsageError,
    CheckpointError,
    WorkerError,
    PolicyError,
    ValueError,
    ImportError,
    OSError,
)
OF_THE_MACHINE = ("device", "num_envs", "num_workers", "trust")  # of the evaluation, not of the run


@dataclass(frozen=True)
class Subject:
    """An agent to evaluate: a run's agent, or the user's own policy.

    Args:
        run: the run's folder, or the folder for the table of the user's own policy.
        config: the run's config with the requested scene and machine settings.
        agent: its policy and observations.
        frames: the frames that it was trained for.
    """

    run: RunFolder
    config: Config
    agent: Agent
    frames: int


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="evaluate")
def run(config: DictConfig) -> None:
    """Runs episodes of saved agents and of baselines, prints tables and saves the rows."""
    try:
        asked = plain_config(config)
        validated(EvaluateConfig, asked, own_keys())
        own = [name for name in as_list(asked["policy"]) if is_reference(name)]
        if own:
            evaluate_own(asked, own)
            return
        runs = runs_in(as_list(asked["run"]))
        with ExitStack() as stack:
            for folder in runs:
                stack.enter_context(folder.held("evaluating"))
            evaluate(asked, runs)
    except MISTAKES as error:
        exit_with(error)


def runs_in(paths: Sequence[str]) -> list[RunFolder]:
    """Returns the runs in folders of runs and of sweeps, each once.

    Raises:
        RunFolderError: there is no run in one of them.
    """
    runs: dict[Path, RunFolder] = {}
    for path in paths:
        for run in RunFolder.all_in(path):
            runs.setdefault(run.path.resolve(), run)
    return list(runs.values())


def evaluate(asked: Config, runs: Sequence[RunFolder]) -> None:
    """Evaluates the agents of runs whose folders are locked.

    Runs with the same scene, camera and renderer share environments and episodes.
    """
    subjects = [load_subject(asked, run) for run in runs]
    by_street: dict[str, list[Subject]] = {}
    for subject in subjects:
        street = json.dumps([subject.config[key] for key in ("scene", "renderer")])
        by_street.setdefault(street, []).append(subject)
    with StopRequest() as stop:
        for group in by_street.values():
            compare(asked, group, stop)
            if stop:
                break
        else:
            for subject in subjects:
                film(asked, subject)
    if stop:
        sys.exit(stop.exit_code)


def evaluate_own(asked: Config, names: Sequence[str]) -> None:
    """Evaluates the user's own policies, one after the other.

    Raises:
        PolicyError: a policy can't be loaded, fails, or returns no actions.
    """
    with StopRequest() as stop:
        for name in names:
            folder = asked["output"] or f"outputs/evaluate/{folder_name(name)}"
            if Path(folder, "config.yaml").exists():
                raise UsageError(f"output={folder} is a run's folder; give another")
            subject = load_own(asked, name, RunFolder(folder))
            with subject.run.held("evaluating"):
                compare({**asked, "policy": name}, [subject], stop)
                if stop:
                    break
                film(asked, subject)
    if stop:
        sys.exit(stop.exit_code)


def load_own(asked: Config, name: str, folder: RunFolder) -> Subject:
    """Returns the user's own policy with its observations.

    Raises:
        PolicyError, TableError: as `check_card`, `load_policy` and `RunFolder.read_episodes`.
    """
    folder.read_episodes()
    config = {key: asked[key] for key in (*OF_THE_MACHINE, "scene", "representations")}
    config |= {"flow": asked.get("flow") or {"source": "exact"}, "noise": asked.get("noise")}
    config |= {"renderer": "auto"}
    config |= {"speed": "normal", "seed": ""}  # of its training, which is unknown
    env = env_from_config(config, num_envs=1, num_workers=0)
    device = choose_device(config["device"])
    task = Task(
        scene=config["scene"]["name"],
        representations=config["representations"],
        observation_spec=Composite(
            {name: env.observation_spec[name][0] for name in config["representations"]}
        ),
        action_spec=env.action_spec[0],
        intrinsics=torch.from_numpy(street_envs(env)[0].K),
        device=device,
    )
    env.close()
    check_card(name, task)
    agent = Agent.from_config(load_policy(name, task), config, device)
    return Subject(folder, config, agent, frames=0)


def compare(asked: Config, subjects: Sequence[Subject], stop: StopRequest) -> None:
    """Runs the episodes of agents of one scene; keeps finished ones even if interrupted."""
    speeds, policies, baselines = (as_list(asked[key]) for key in ("speed", "policy", "baselines"))
    rates = [float(rate) for rate in as_list(asked["fps"])]
    comparison = Comparison(
        speeds=speeds,
        fps=rates,
        episodes=asked["episodes"],
        seed=asked["seed"],
        policies=policies,
        baselines=baselines,
        agents=len(subjects),
    )
    config = subjects[0].config
    num_envs = min(comparison.rides, config["num_envs"])
    arena = arena_from_config(config, [subject.agent for subject in subjects], num_envs)
    try:
        comparison.run(arena, lambda: bool(stop))
    finally:
        for number, subject in enumerate(subjects):
            keep(subject, comparison.rows(number))
        arena.close()


def keep(subject: Subject, rows: list[Row]) -> None:
    """Prints the results of one run's episodes, if there are any, and adds them to its table."""
    if not rows:
        return
    run = subject.run
    rows = with_origin(rows, subject.config, subject.frames, "evaluate")
    run.log_episodes(rows)
    write_failures(run.failures_path, run.read_episodes())
    print(run.path)
    print_table(rows)
    print_failures(rows)
    print(f"{len(rows)} episodes are in {run.evaluation_path}")


def as_list(value: Any) -> list[Any]:
    """Returns a list unchanged, and a single value as a list of one."""
    return value if isinstance(value, list) else [value]


def load_subject(asked: Config, run: RunFolder) -> Subject:
    """Returns a run's agent in the requested scene, by default its own.

    Raises:
        UsageError, TableError: its config or its table is damaged, or the scene has the name of its
            own and is another; all are checked before any episode is run.
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
    """
    own = validated_run(run.read_config(), f"{run.path}/config.yaml")
    run.read_episodes()
    path = run.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own), path)
    here = {key: asked[key] for key in OF_THE_MACHINE}
    scene = asked.get("scene")
    if scene is not None:  # the agent keeps its camera in other scenes
        here["scene"] = scene | {"camera": own["scene"]["camera"]}
    config = own | here
    check_scene(run, own["scene"], config["scene"])
    env = env_from_config(config, num_envs=1, num_workers=0)
    policy = policy_from_config(config, env, trust=config["trust"])
    env.close()
    try:
        policy.load_state_dict(state["policy"])
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"the agent of {run.path} can't look at scene '{config['scene']['name']}', which has "
            f"other classes than its own ({reason})"
        ) from error
    device = choose_device(config["device"])
    agent = Agent.from_config(policy, config, device)
    return Subject(run, config, agent, state["frames"])


def check_scene(run: RunFolder, own: Config, asked: Config) -> None:
    """Checks that episodes in a scene can't be taken for some in the run's own scene.

    Raises:
        UsageError: it has the name of the run's own scene and differs from it.
    """
    if asked["name"] != own["name"]:
        return
    for place, there, here in differences(own, asked, "scene"):
        raise UsageError(
            f"{run.path} was trained with {place}={shown(there)}, and rows with {shown(here)} "
            f"would be taken for the same scene, '{own['name']}': give this one another name with "
            "scene.name=, or leave scene= out"
        )


def film(asked: Config, subject: Subject) -> None:
    """Writes `video` episodes for each speed and frame rate."""
    config, run = subject.config, subject.run
    for speed, rate in product(as_list(asked["speed"]), as_list(asked["fps"])):
        for number in range(asked["video"]):
            path = run.video_path(f"{speed}_{rate:g}fps_{number}")
            make = partial(env_from_config, config, speed=speed, frame_rate_hz=float(rate))
            seen, seed = config["representations"], asked["seed"] + number
            policy = subject.agent.policy
            if isinstance(policy, ForeignPolicy):
                policy = policy.alone()
            record_episode(make, policy, seen, path, seed=seed)
            print(f"video: {path}")


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
