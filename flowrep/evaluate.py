"""Evaluates agents: `python -m flowrep.evaluate run=outputs/... 'speed=[low,high]'`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from flowrep.extras import require

require("evaluation", "train", "hydra", "pydantic", module=__name__)

from flowrep.config.cli import EXIT_USAGE, is_a_mistake, print_error, run_command
from flowrep.config.run_names import folder_name
from flowrep.config.usage import UsageError
from flowrep.experiment.schema import EvaluateConfig
from flowrep.progress import StopRequest

if TYPE_CHECKING:
    from flowrep.experiment.agents import Agent
    from flowrep.experiment.evaluation import PairedEvaluation
    from flowrep.experiment.run import RunFolder


class Candidate(NamedTuple):
    """An agent to evaluate: the folder of its table, how it is loaded, and how it acts."""

    folder: RunFolder
    load: Callable[[], Agent]
    policies: Sequence[str]


def run(config: EvaluateConfig) -> None:
    """Runs episodes of agents and baselines, one agent after the other, and saves the rows.

    If a folder is in use, or an agent can't be evaluated or saved, the others still are, and the
    exit code is 1. Baselines drive once in each scene.
    """
    candidates = candidates_of(config)

    from flowrep.agent import keep_freed_memory

    keep_freed_memory()
    evaluations: dict[str, PairedEvaluation] = {}
    failed: list[str] = []
    with StopRequest() as stop:
        for candidate in candidates:
            try:
                with candidate.folder.locked():
                    evaluate_one(config, candidate, evaluations, stop)
            except Exception as error:
                if len(candidates) == 1 or not is_a_mistake(error):
                    raise
                print_error(error)
                failed.append(str(candidate.folder.path))
            if stop:
                sys.exit(stop.exit_code)
    if failed:
        print_error(f"not evaluated or not saved, see above: {', '.join(failed)}")
        sys.exit(1 if len(failed) < len(candidates) else EXIT_USAGE)


def candidates_of(config: EvaluateConfig) -> list[Candidate]:
    """Returns the agents to evaluate: of runs and sweeps, or policies from other projects."""
    from flowrep.experiment.policies import ForeignPolicy, SavedPolicy, policy_of
    from flowrep.experiment.run import RunFolder

    runs = RunFolder.all_in(config.run or [])
    for name in config.other_policies:
        if not isinstance(policy_of(name), ForeignPolicy | SavedPolicy):
            raise UsageError(f"policy={name}: evaluate a run by run=, a baseline by baselines=")

    from flowrep.experiment.agents import Agent

    machine = config.model_dump(include={"device", "num_envs", "num_workers"})
    if not config.other_policies:
        load = partial(Agent.load, scene=config.scene, trusted=config.trusted, **machine)
        return [Candidate(run, partial(load, run.path), config.policy) for run in runs]
    keys = ("scene", "representations", "flow", "motion", "noise")
    maps = {key: getattr(config, key) for key in keys}
    candidates = []
    for name in config.other_policies:
        folder = Path(config.output or f"outputs/evaluate/{folder_name(name)}")
        if (folder / "config.yaml").exists():
            raise UsageError(f"output={folder} is a run's folder; give another")
        load = partial(Agent.load, name, trusted=config.trusted, **maps, **machine)
        candidates.append(Candidate(RunFolder(folder), load, [name]))
    return candidates


def evaluate_one(
    config: EvaluateConfig,
    candidate: Candidate,
    evaluations: dict[str, PairedEvaluation],
    stop: StopRequest,
) -> None:
    """Runs an agent's episodes, keeps whole groups even if interrupted."""
    from flowrep.envs.torchrl_env import usable_device
    from flowrep.experiment import build
    from flowrep.experiment.evaluation import PairedEvaluation
    from flowrep.experiment.outcomes import print_results

    agent, folder = candidate.load(), candidate.folder
    folder.read_episodes()  # a damaged table is refused before hours of episodes, not after
    origin = agent.origin("evaluate")
    if config.other_policies:
        keys = {"representations", "flow", "motion", "noise"}
        maps = {"order": [*agent.config.representations], **agent.config.model_dump(include=keys)}
        folder.note_maps(candidate.policies[0], origin["scene_id"], maps)
    else:  # the networks of other policies may be large
        build.share_cores(usable_device(agent.config.device), agent.config.flow)
    # Agents of one scene share the baselines' episodes.
    rates = config.fps or [agent.config.scene.frame_rate_hz]
    episodes = config.speed, rates, config.episodes, config.seed
    evaluation = evaluations.setdefault(
        f"{origin['scene_id']} {candidate.policies}",
        PairedEvaluation(*episodes, candidate.policies, config.baselines),
    )

    def try_to_save() -> None:
        with suppress(OSError):  # at the end it is reported
            folder.save_episodes(evaluation.records(**origin))

    num_envs = agent.config.num_envs
    try:
        evaluation.run(agent.make_env, agent.policy, num_envs, stop=stop, save=try_to_save)
    finally:
        if records := evaluation.records(**origin):
            try:
                folder.log_episodes(records)
            except OSError as error:
                raise OSError(f"{folder.path}: {error}; then evaluate again") from error
            print(folder.path)
            print_results([record.row() for record in records])
            print(f"{len(records)} of {evaluation.total} episodes are in {folder.evaluation_path}")
        if stop and len(records) < evaluation.total:
            print(
                "stopped: combinations of policy, speed and frame rate with missing episodes are "
                "not saved, because short episodes end first and would bias them. The same command "
                "runs them again"
            )


def main() -> None:
    """Entry point."""
    run_command("evaluate", run, EvaluateConfig)


if __name__ == "__main__":
    main()
