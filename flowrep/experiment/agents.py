"""Trains, loads, evaluates and saves agents from Python."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from flowrep.agent import save_checkpoint, torch_threads
from flowrep.baselines import BaselinePolicy
from flowrep.config.cli import composed
from flowrep.config.options import validated
from flowrep.config.usage import UsageError
from flowrep.experiment import build
from flowrep.experiment.evaluation import EVALUATION_ENVS, FIRST_SEEDS, Driver, PairedEvaluation
from flowrep.experiment.outcomes import EpisodeRecord
from flowrep.experiment.policies import packed, policy_of
from flowrep.experiment.run import RunFolder
from flowrep.experiment.runner import Runner
from flowrep.experiment.schema import Episodes, TrainConfig
from flowrep.progress import StopRequest


class Agent(Driver):
    """A policy, usually a trained one, and the config of the env in which it acts.

    >>> agent = Agent.load("pretrained", scene="straight_road")
    >>> [episode] = agent.evaluate(episodes=1)
    >>> episode.outcome
    'success'
    """

    @classmethod
    def train(
        cls,
        *,
        folder: str | Path | None = None,
        callback: Callable[[dict[str, float]], Any] | None = None,
        **overrides: Any,
    ) -> Agent:
        """Trains an agent as `python -m flowrep.train` does, and returns it.

        The run is saved in its folder, without a final evaluation, which
        `python -m flowrep.train resume=<folder>` adds. Ctrl-C saves the run, too, and raises
        KeyboardInterrupt.

        Args:
            folder: the run's folder; by default outputs/<day>/<time>_<name>.
            callback: called with each row of metrics.csv, `frames` included.
            overrides: keys of conf/train.yaml and their values, such as `scene="s_turn"`,
                `representations=["ego", "obj"]`, `preset="laptop"`, `total_frames=50_000` or
                `evaluation={"every_frames": 0}`. To choose a section and also set a key in it, add
                `**{"scene.time_limit_steps": 100}`. For the scene in mine/scene/alley.yaml, add
                `**{"hydra.searchpath": ["file://mine"]}` to `scene="alley"`.

        Raises:
            UsageError: a key or a value is wrong; the message names it.
        """
        if "resume" in overrides:
            raise UsageError("resume=: continue a run with python -m flowrep.train resume=<folder>")
        config, default = composed(TrainConfig, overrides)
        config = build.resolved(config)
        run = RunFolder(default if folder is None else folder)
        run.check_is_new()
        with (
            run.locked(),
            StopRequest() as stop,
            torch_threads(torch.get_num_threads()),  # the caller's again afterwards
            closing(Runner(config, run, on_log=callback)) as runner,
        ):
            run.write_config(config.plain())
            runner.train(stop)
            driver = runner.driver()
        if stop:
            raise KeyboardInterrupt(f"stopped after {runner.frames} frames; saved in {run.path}")
        return cls(driver.policy, config, runner.frames, config.scene)

    @classmethod
    def load(
        cls,
        name: str | Path,
        *,
        trusted: Collection[str] = (),
        precision: str | None = None,
        **env: Any,
    ) -> Agent:
        """Returns what `policy=` names, in its env.

        Args:
            name: the folder of a run, a .safetensors file that `save` wrote, "pretrained" (the
                agent of the scene that comes with flowrep), a baseline, or a policy from another
                project: path.py:make or package.module:make.
            trusted: classes outside of flowrep that a run may name; their code runs.
            precision: the number format of a trained agent's networks, instead of the run's.
            env: `scene`, a name or a definition, by default that of the training or of conf/ (a
                trained agent keeps the camera of its training); `device`, by default "auto";
                `num_envs` side by side; `num_workers`, processes that step them, or "auto". But for
                a baseline also `noise` as in conf/, and for a policy from another project
                `representations`, the names of its maps or a mapping from name to options, `flow`
                and `motion`.

        Raises:
            UsageError: there is no such agent.
            CheckpointError: a file is damaged, or the agent can't act in this scene.
        """
        return cls(*policy_of(name).load(env, trusted, precision))

    def evaluate(
        self,
        episodes: int = 100,
        *,
        speeds: Sequence[str] | None = None,
        fps: Sequence[float] | None = None,
        seed: int = FIRST_SEEDS["evaluate"],
        policies: Sequence[str] = ("greedy",),
        baselines: Sequence[str] = (),
    ) -> list[EpisodeRecord]:
        """Returns the records of the episodes that `flowrep.evaluate` runs for the same seed.

        Args:
            episodes: the number of episodes for each policy, speed and frame rate.
            speeds: the pedestrians' speed modes; by default that of the training.
            fps: frame rates, 1/s; by default the scene's.
            seed: of the first episode; the others follow.
            policies: "greedy" takes the likeliest action, "sampled" draws one.
            baselines: such as "planner", "never_turn" and "random", on the same episodes.
        """
        values = {
            "episodes": episodes,
            "speeds": [self.config.speed] if speeds is None else speeds,
            "fps": [self.config.scene.frame_rate_hz] if fps is None else fps,
            "seed": seed,
            "policies": policies,
            "baselines": baselines,
        }
        checked = dict(validated(Episodes, values))
        if checked["policies"] != ["greedy"] and not hasattr(self.policy, "get_dist"):
            raise UsageError("policies: only a trained agent can draw its actions")
        if isinstance(self.policy, BaselinePolicy):
            checked["policies"] = [self.policy.name]
        evaluation = PairedEvaluation(**checked)
        evaluation.run(self.make_env, self.policy, EVALUATION_ENVS)
        return evaluation.records(**self.origin("evaluate"))

    def save(self, path: str | Path, *, small: bool = False) -> None:
        """Writes the policy and its config, with the scene of its training, for `load` to read.

        With `small`, each weight takes one byte, see `packed`.
        """
        if not isinstance(self.config, TrainConfig):
            raise UsageError("only an agent that flowrep trained has weights to save")
        if Path(path).suffix != ".safetensors":
            raise UsageError(f"save to a file whose name ends in .safetensors, not to '{path}'")
        weights = dict(self.policy.state_dict())  # type: ignore[attr-defined]
        # Wherever it drives now, what it learnt is of the scene of its training.
        config = self.config.model_copy(update={"scene": self.trained_in or self.config.scene})
        state = {"frames": self.frames, "config": config.plain()}
        save_checkpoint(path, state | {"policy": packed(weights) if small else weights})
