"""Evaluates agents: `python -m flowrep.evaluate run=outputs/... speed=[low,high]`."""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from flowrep.extras import require

require("evaluation", "train", "hydra", "pydantic", module=__name__)

from flowrep.agent import CheckpointError
from flowrep.config import UsageError
from flowrep.config.cli import EXIT_USAGE, folder_name, print_error, run_command
from flowrep.config.schema import EvaluateConfig
from flowrep.envs import WorkerError
from flowrep.exchange.policies import ForeignPolicy, PolicyError
from flowrep.experiment import build
from flowrep.experiment.comparison import Comparison, Row, print_table
from flowrep.experiment.failures import print_failures, write_failures
from flowrep.experiment.run import RunFolder
from flowrep.progress import StopRequest
from flowrep.subjects import Subject, load_own, load_subject
from flowrep.viz.film import record_episode

Config = Mapping[str, Any]
MISTAKES = (
    UsageError,
    CheckpointError,
    WorkerError,
    PolicyError,
    ValueError,
    ImportError,
    OSError,
)


def run(config: EvaluateConfig) -> None:
    """Runs episodes of saved agents and of baselines, prints tables and saves the rows."""
    if config.own_policies:
        evaluate_own(config.plain(), config.own_policies)
    else:
        evaluate(config.plain(), runs_in(config.run or []))


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
    """Evaluates the agents of runs, and locks their folders meanwhile.

    Runs with the same scene, camera and renderer share environments and episodes. A run that is in
    use, or can't be evaluated or saved, is reported and does not stop the others; the exit code is
    then 1.
    """
    saved: list[Subject] = []
    with ExitStack() as locks:
        by_street: dict[str, list[Subject]] = {}
        for subject in load_subjects(asked, runs, locks):
            street = json.dumps([subject.config.scene, subject.config.renderer])
            by_street.setdefault(street, []).append(subject)
        with StopRequest() as stop:
            for group in by_street.values():
                saved += compare(asked, group, stop)
                if stop:
                    break
            else:
                for subject in saved:
                    film(asked, subject, stop)
    if stop:
        sys.exit(stop.exit_code)
    done = [subject.run for subject in saved]
    if missing := [str(run.path) for run in runs if run not in done]:
        print_error(f"not evaluated or not saved, see above: {', '.join(missing)}")
        sys.exit(1 if done else EXIT_USAGE)


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
            run = RunFolder(folder)
            with run.held("evaluating"):
                subject = load_own(asked, name, run)
                saved = compare({**asked, "policy": name}, [subject], stop)
                if stop:
                    break
                if not saved:
                    sys.exit(EXIT_USAGE)
                film(asked, subject, stop)
    if stop:
        sys.exit(stop.exit_code)


def compare(asked: Config, subjects: Sequence[Subject], stop: StopRequest) -> list[Subject]:
    """Runs the episodes of agents of one scene; keeps finished ones even if interrupted.

    Returns:
        The agents whose episodes are saved; why others can't be is printed.
    """
    comparison = comparison_of(asked, len(subjects))

    def save(number: int) -> None:
        subject = subjects[number]
        with suppress(OSError):  # `keep` tries again and reports it
            subject.save(subject.rows(comparison, number))

    config = subjects[0].config
    num_envs = min(comparison.rides, config.num_envs)
    arena = build.arena(config, [subject.agent for subject in subjects], num_envs)
    with closing(arena):
        try:
            comparison.run(arena, lambda: bool(stop), save)
        finally:
            results = [(s, s.rows(comparison, number)) for number, s in enumerate(subjects)]
            saved = [(subject, rows) for subject, rows in results if keep(subject, rows)]
            for subject, rows in saved:  # after all are saved, since the output may be closed
                show(subject, rows)
    return [subject for subject, _ in saved]


def comparison_of(asked: Config, agents: int) -> Comparison:
    """Returns the requested episodes of so many agents."""
    speeds, policies, baselines = (as_list(asked[key]) for key in ("speed", "policy", "baselines"))
    return Comparison(
        speeds=speeds,
        fps=[float(rate) for rate in as_list(asked["fps"])],
        episodes=asked["episodes"],
        seed=asked["seed"],
        policies=policies,
        baselines=baselines,
        agents=agents,
    )


def keep(subject: Subject, rows: Sequence[Row]) -> bool:
    """Adds episodes to a run's table; returns False after printing why they can't be."""
    run = subject.run
    if not rows:
        return True
    try:
        subject.save(rows)
        run.plot_episodes(rows)
        write_failures(run.failures_path, run.read_episodes())
    except OSError as error:
        print_error(
            f"{run.path}: {error}. Free some space or make the folder writable, then evaluate again"
        )
        return False
    return True


def show(subject: Subject, rows: Sequence[Row]) -> None:
    """Prints the results of one run's episodes, if there are any."""
    if not rows:
        return
    print(subject.run.path)
    print_table(rows)
    print_failures(rows)
    print(f"{len(rows)} episodes are in {subject.run.evaluation_path}")


def as_list(value: Any) -> list[Any]:
    """Returns a list unchanged, and a single value as a list of one."""
    return value if isinstance(value, list) else [value]


def load_subjects(asked: Config, runs: Sequence[RunFolder], locks: ExitStack) -> list[Subject]:
    """Returns the agents of runs, whose folders `locks` holds; prints why some can't be loaded.

    Raises:
        one of `MISTAKES`, if none can be.
    """
    subjects = []
    for run in runs:
        try:
            locks.enter_context(run.held("evaluating"))
            subjects.append(load_subject(asked, run))
        except MISTAKES as error:
            if not subjects and run is runs[-1]:
                raise
            print_error(error)
    return subjects


def film(asked: Config, subject: Subject, stop: StopRequest) -> None:
    """Writes `video` episodes for each speed and frame rate, until a stop is asked for."""
    config, run = subject.config, subject.run
    name = config.scene["name"]
    where = "" if name == subject.trained_in else f"{name}_"
    for speed, rate in product(as_list(asked["speed"]), as_list(asked["fps"])):
        for number in range(asked["video"]):
            if stop:
                return
            episode_seed = (asked["seed"] + number) % (1 << 31)
            path = run.video_path(f"{where}{speed}_{rate:g}fps_{episode_seed}")
            make = partial(build.env, config, speed=speed, frame_rate_hz=float(rate))
            seen, policy = config.representations, subject.agent.policy
            if isinstance(policy, ForeignPolicy):
                policy = policy.alone()
            record_episode(make, policy, seen, path, episode_seed=episode_seed)
            print(f"video: {path}")


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
