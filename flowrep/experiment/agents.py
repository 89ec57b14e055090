"""Trains, loads, evaluates and saves agents from Python, and loads what `policy=` names."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Composite

from flowrep.agent import CheckpointError, load_checkpoint, save_checkpoint, torch_threads
from flowrep.config.cli import composed
from flowrep.config.schema import (
    EnvConfig,
    Episodes,
    ExactFlowOptions,
    Machine,
    NoiseOptions,
    TrainConfig,
    check_policy,
    policy_kind,
    validated,
    validated_run,
)
from flowrep.envs import street_envs
from flowrep.experiment import build
from flowrep.experiment.evaluation import (
    EVALUATION_ENVS,
    FIRST_SEEDS,
    Driver,
    PairedEvaluation,
)
from flowrep.experiment.external import Task, check_card, load_policy
from flowrep.experiment.outcomes import EpisodeRecord
from flowrep.experiment.run import RunFolder, check_origin, origin_of
from flowrep.experiment.runner import Runner
from flowrep.progress import StopRequest
from flowrep.scenes import Scene, load_scene
from flowrep.transforms.stack import REPRESENTATIONS, representation_options
from flowrep.usage import UsageError, closest_first

PRETRAINED = Path(__file__).parents[1] / "pretrained"
"""Agents that come with flowrep, one for each scene; README.md there is their card."""
_SCALE = ".scale"


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
        config, default, typed = composed(overrides)
        run = RunFolder(default if folder is None else folder)
        run.check_is_new()
        with (
            run.held("training"),
            StopRequest() as stop,
            torch_threads(torch.get_num_threads()),  # the caller's again afterwards
            closing(Runner(config, run, on_log=callback)) as runner,
        ):
            run.begin(runner.config, typed)
            runner.train(stop)
        if stop:
            raise KeyboardInterrupt(f"stopped after {runner.frames} frames; saved in {run.path}")
        return cls(runner.agent.policy, runner.config, runner.frames, config.scene)

    @classmethod
    def load(
        cls,
        name: str | Path,
        *,
        scene: str | Mapping[str, Any] | Scene | None = None,
        representations: Mapping[str, Any] | Sequence[str] | None = None,
        flow: Any = None,
        motion: str | None = None,
        noise: NoiseOptions | None = None,
        trusted: Collection[str] = (),
        precision: str | None = None,
        device: str = "auto",
        num_envs: int | None = None,
        num_workers: int | str = 0,
    ) -> Agent:
        """Returns an agent that acts in `scene`, by default in the scene of its training.

        Args:
            name: the folder of a run, a .safetensors file that `save` wrote, "pretrained" (the
                agent of the scene that comes with flowrep), a baseline, or a policy from another
                project: path.py:make, package.module:make or path.pt2.
            scene: a scene's name or definition; the camera remains that of the training.
            representations: the maps that a policy from another project reads: names, or a mapping
                from name to options. The next three are for such a policy, too.
            flow: the source of raw and obj, as in conf/flow; exact if None.
            motion: the source of the camera's motion, "exact" or "estimated"; exact if None.
            noise: errors of depth and of the camera's motion; none if None.
            trusted: a class, or classes, outside of flowrep that a run may name; their code runs.
            precision: the number format of its networks, instead of the run's.
            device: of its networks and envs.
            num_envs: envs side by side; by default as many as in its training.
            num_workers: processes that step them, or "auto".

        Raises:
            UsageError: there is no such agent.
            CheckpointError: a file is damaged, or the agent can't act in this scene.
        """
        check_policy(name := str(name))
        kind = policy_kind(name)
        where = {"device": str(device), "num_envs": num_envs, "num_workers": num_workers}
        machine = {k: v for k, v in validated(Machine, where) if v is not None}
        given_scene = None if scene is None else load_scene(scene)
        if isinstance(representations, str):
            raise UsageError(f"representations: give a list, ['{representations}']")
        if representations is None or isinstance(representations, Mapping):
            maps = dict(representations or {})
        else:
            names = {"representations": [*representations]}
            maps = composed(names)[0].representations
        if kind != "external":
            # `_target_` alone is no map: it trusts a class that a run names, as `trusted` says.
            chosen = [each for each in maps.values() if {*(each or {})} != {"_target_"}] or None
            given = {"representations": chosen, "flow": flow, "motion": motion, "noise": noise}
            for key, value in given.items():
                if value is not None:
                    raise UsageError(f"{key}= is for another project's policy, not for {name}")
        if kind in ("baseline", "external"):
            if precision is not None:
                raise UsageError(f"precision= is for a trained agent, not for policy={name}")
            if kind == "external" and not maps:
                raise UsageError(f"representations needs a value for policy={name}")
            values = {"flow": flow, "motion": motion, "noise": noise} | machine
            config = _config_without_run(given_scene, maps if kind == "external" else {}, values)
            return cls(_external(name, config) if kind == "external" else name, config)
        trained, frames, weights = _stored(name, given_scene, trusted)
        if given_scene is not None:
            machine["scene"] = replace(given_scene, camera=trained.scene.camera)
        config = build.with_precision(trained.model_copy(update=machine), precision)
        with closing(build.env(config, num_envs=1, num_workers=0)) as env:
            policy = build.policy(config, env)
        try:
            policy.load_state_dict(weights)
        except RuntimeError as error:
            reason = str(error).splitlines()[-1].strip()
            raise CheckpointError(
                f"the agent of {name} can't be used in scene '{config.scene.name}', whose "
                f"classes are not those of its training ({reason})"
            ) from error
        return cls(policy, config, frames, trained.scene)

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
        if isinstance(self.policy, str):
            checked["policies"] = [self.policy]
        evaluation = PairedEvaluation(**checked)
        evaluation.run(self.make_env, self.policy, EVALUATION_ENVS)
        return evaluation.records(**self.origin("evaluate"))

    def save(self, path: str | Path, *, small: bool = False) -> None:
        """Writes the policy and its config, with the scene of its training, for `load` to read.

        With `small`, each weight takes one byte, see `packed`.
        """
        if not isinstance(self.config, TrainConfig) or isinstance(self.policy, str):
            raise UsageError("only an agent that flowrep trained has weights to save")
        if Path(path).suffix != ".safetensors":
            raise UsageError(f"save to a file whose name ends in .safetensors, not to '{path}'")
        weights = dict(self.policy.state_dict())  # type: ignore[attr-defined]
        config = self.config.model_copy(update={"scene": self.trained_in or self.config.scene})
        state = {"frames": self.frames, "config": config.plain()}
        save_checkpoint(path, state | {"policy": packed(weights) if small else weights})


def _config_without_run(
    scene: Scene | None, maps: Mapping[str, Any], values: Mapping[str, Any]
) -> EnvConfig:
    """Returns the config of the env of a baseline or of a policy from another project."""
    defaults: dict[str, Any] = {
        "scene": scene or load_scene("straight_road"),
        # Replaced below: the schema would refuse maps whose options have defaults.
        "representations": {"rgb": {}},
        "flow": ExactFlowOptions(),
        "motion": "exact",
        "noise": NoiseOptions(),
        "speed": "normal",
        "renderer": "auto",
        "seed": 0,
        "num_envs": 1,
    }
    given = {key: value for key, value in values.items() if value is not None}
    config = validated(EnvConfig, defaults | given)
    return config.model_copy(update={"representations": maps})


def _stored(
    name: str, scene: Scene | None, trusted: Collection[str]
) -> tuple[TrainConfig, int, dict[str, Tensor]]:
    """Returns config, frames and weights of a trained agent."""
    if policy_kind(name) == "saved":
        path = _pretrained(scene) if name == "pretrained" else Path(name)
        stored = load_checkpoint(path, ["config", "frames", "policy"])
        config = validated_run(stored["config"], path.name, trusted)
        return config, stored["frames"], unpacked(_weights(stored, path))
    run = RunFolder.existing(name)
    config, path = run.config(trusted), run.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(config.plain()), path)
    return config, state["frames"], _weights(state, path)


def _weights(state: Mapping[str, Any], path: Path) -> dict[str, Tensor]:
    weights = state["policy"]
    are_tensors = isinstance(weights, dict) and all(isinstance(w, Tensor) for w in weights.values())
    if not (are_tensors and isinstance(state["frames"], int)):
        raise CheckpointError(f"{path} is a checkpoint, but not of an agent")
    return weights


def _pretrained(scene: Scene | None) -> Path:
    if scene is None:
        raise UsageError("scene needs a value for policy=pretrained")
    files = {file.stem: file for file in PRETRAINED.glob("*.safetensors")}
    if scene.name not in files:
        there = closest_first(scene.name, files)
        raise UsageError(
            f"no agent for scene '{scene.name}' comes with flowrep; there are: {there}"
        )
    return files[scene.name]


def _external(reference: str, config: EnvConfig) -> Any:
    """Returns a policy from another project, built for the task in the config's env."""
    with closing(build.env(config, num_envs=1, num_workers=0)) as env:
        maps = {name: env.observation_spec[name][0] for name in config.representations}
        given = config.representations.items()
        task = Task(
            scene=config.scene.name,
            representations={n: _whole_options(n) | dict(options or {}) for n, options in given},
            observation_spec=Composite(maps),
            action_spec=env.action_spec[0],
            intrinsics=torch.from_numpy(street_envs(env)[0].K),
            device=build.device(config.device),
        )
    check_card(reference, task)
    return load_policy(reference, task)


def _whole_options(name: str) -> dict[str, Any]:
    """Returns a representation's options with their defaults, none for one of the user's."""
    return representation_options(name) if name in REPRESENTATIONS else {}


def packed(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns matrices and filters as int8 with a scale for each row, other weights unchanged.

    A weight is rounded to 1/127 of the largest in its row. That is coarser than bfloat16, in which
    agents compute; README.md of the pretrained agents gives the success of one with and without it.
    """
    stored = {}
    for name, weight in weights.items():
        stored[name] = weight
        if weight.is_floating_point() and weight.ndim > 1:
            scale = weight.flatten(1).abs().amax(1) / 127
            columns = scale.clamp(min=1e-12).view(-1, *[1] * (weight.ndim - 1))
            stored[name] = (weight / columns).round().to(torch.int8)
            stored[name + _SCALE] = scale
    return stored


def unpacked(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the weights that `packed` stored; others are unchanged.

    >>> weights = {"weight": torch.tensor([[1.0, -0.5], [0.0, 0.0]])}
    >>> unpacked(packed(weights))["weight"]
    tensor([[ 1.0000, -0.5039],
            [ 0.0000,  0.0000]])
    """
    weights = dict(stored)
    for whole in [key for key in stored if key + _SCALE in stored]:
        scale = weights.pop(whole + _SCALE)
        weights[whole] = stored[whole] * scale.view(-1, *[1] * (stored[whole].ndim - 1))
    return weights
