"""What `policy=` names, a class a kind: a run, a saved agent, a baseline, a foreign policy.

Commands check names before they import PyTorch, so here only what loads a policy imports it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, get_args

from flowrep.config.cli import composed, typed_keys
from flowrep.config.options import BaselineName, validated
from flowrep.config.usage import UsageError, closest_first
from flowrep.experiment.provenance import check_origin, differences, origin_of
from flowrep.experiment.run import RunFolder
from flowrep.experiment.schema import EnvConfig, Machine, TrainConfig, validated_run
from flowrep.scenes import Scene, load_scene

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDictBase
    from torch import Tensor
    from torchrl.data import Composite, TensorSpec

PRETRAINED = Path(__file__).parents[1] / "pretrained"
"""Agents that come with flowrep, one for each scene; README.md there is their card."""
Loaded = tuple[Any, EnvConfig, int, Scene | None]
"""The fields of a `Driver`: policy, config of its env, frames and scene of its training."""
Stored = tuple[TrainConfig, dict[str, Any], Path]


def policy_of(name: str | Path) -> NamedPolicy:
    """Returns what `policy=` names; raises UsageError if that is nothing."""
    name = str(name)
    if name in get_args(BaselineName):
        return NamedBaseline(name)
    if Path(name).is_dir():  # its name may hold a colon
        return RunPolicy(name)
    if name == "pretrained" or name.endswith(".safetensors"):
        return SavedPolicy(name)
    if ":" in name:
        return ForeignPolicy(name)
    raise UsageError(
        f"policy={name}: give {', '.join(get_args(BaselineName))}, pretrained, a run's folder, "
        "path.safetensors, path.py:make or package.module:make"
    )


class NamedPolicy:
    """A policy by its name, of one of four kinds."""

    takes: ClassVar[tuple[str, ...]] = ("scene", "device", "num_envs", "num_workers")
    """The keywords of `Agent.load` that describe its env."""

    def __init__(self, name: str) -> None:
        self.name = name

    def load(self, env: Mapping[str, Any], trusted: Collection[str], precision: Any) -> Loaded:
        """Returns the policy in the env that keywords describe; None stands for none."""
        raise NotImplementedError

    def _given(self, env: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the keywords that were given, after a check of those of every kind."""
        given = {key: value for key, value in env.items() if value is not None}
        if others := given.keys() - self.takes:
            raise UsageError(f"{min(others)}= is not for policy={self.name}: leave it out")
        machine = {"device": "auto", "num_envs": None, "num_workers": 0}
        machine |= {key: given[key] for key in machine if key in given}
        given |= {key: value for key, value in validated(Machine, machine) if value is not None}
        return given | ({"scene": load_scene(given["scene"])} if "scene" in given else {})


class NamedBaseline(NamedPolicy):
    """A policy that reads the simulator's state and sees no map, such as the planner."""

    def load(self, env: Mapping[str, Any], trusted: Collection[str], precision: Any) -> Loaded:
        """Returns the baseline, in an env that renders nothing."""
        from flowrep.baselines import BaselinePolicy

        config = _env_config(self._given({**env, "precision": precision}))
        return BaselinePolicy(self.name), config.model_copy(update=BaselinePolicy.ENV), 0, None


class TrainedPolicy(NamedPolicy):
    """An agent that flowrep trained: its camera remains that of the training."""

    takes = (*NamedPolicy.takes, "noise")
    precision: str | None = None
    """The number format of its networks where none is given; None for that of the training."""

    def load(self, env: Mapping[str, Any], trusted: Collection[str], precision: Any) -> Loaded:
        """Returns the network with its weights, with `precision` in that number format."""
        from flowrep.agent import CheckpointError
        from flowrep.experiment import build

        maps = env.get("representations")
        # `_target_` alone is no map: it trusts a class that a run names, as `trusted` does.
        if isinstance(maps, Mapping) and all({*(x or {})} == {"_target_"} for x in maps.values()):
            env = {**env, "representations": None}
        given = self._given(env)
        trained, state, path = self.stored(given.get("scene"), trusted)
        if not isinstance(state["frames"], int):
            raise CheckpointError(f"{path} is a checkpoint, but not of an agent")
        if "scene" in given:
            # What the network sees must keep its meaning: flow in pixels depends on the camera, a
            # class id on the scene's categories.
            seen: dict[str, Any] = {"camera": trained.scene.camera}
            if not {"seg", "seg2"}.isdisjoint(trained.representations):
                seen["categories"] = trained.scene.categories
                if new := sorted({*given["scene"].categories} - {*trained.scene.categories}):
                    raise CheckpointError(
                        f"the agent in {path} reads classes and never saw {', '.join(new)} of "
                        f"scene '{given['scene'].name}': train one with scene.categories=all"
                    )
            given["scene"], asked = replace(given["scene"], **seen), given["scene"]
            _check_not_typed(asked, given["scene"])
        config = trained.model_copy(update=given)
        with closing(build.env(config, num_envs=1)) as street:
            config = build.with_precision(config, street.device, precision or self.precision)
            policy = build.policy(config, street)
        try:
            policy.load_state_dict(unpacked(state["policy"]))
        except (RuntimeError, TypeError, AttributeError) as error:
            reason = str(error).splitlines()[-1].strip()
            raise CheckpointError(
                f"the agent in {path} can't be used in scene '{config.scene.name}': the file is "
                f"damaged, or its maps have another size there ({reason})"
            ) from error
        acting = build.evaluated(config, street, policy)
        return acting, config, state["frames"], trained.scene

    def stored(self, scene: Scene | None, trusted: Collection[str]) -> Stored:
        """Returns the config of its training, the state with `frames` and `policy`, their file."""
        raise NotImplementedError


class RunPolicy(TrainedPolicy):
    """The agent of a run, by the run's folder."""

    def stored(self, scene: Scene | None, trusted: Collection[str]) -> Stored:
        """Reads the last checkpoint."""
        from flowrep.agent import load_checkpoint

        run = RunFolder.existing(self.name)
        config, path = run.config(trusted), run.checkpoint_path
        state = load_checkpoint(path, ["origin", "frames", "policy"])
        check_origin(state["origin"], origin_of(config.plain()), path)
        return config, state, path


class SavedPolicy(TrainedPolicy):
    """An agent in a file that `Agent.save` wrote; "pretrained" is flowrep's for the scene."""

    # It may be on another machine now: a CPU that emulates bfloat16 takes ten times as long.
    precision = "auto"

    def __init__(self, name: str) -> None:
        super().__init__(name)
        if name != "pretrained":
            _check_is_there(name, name)

    def load(self, env: Mapping[str, Any], trusted: Collection[str], precision: Any) -> Loaded:
        """Returns the network with its weights; flowrep's drives in a scene of conf/."""
        if self.name == "pretrained" and env.get("scene") is None:
            env = {**env, "scene": composed(TrainConfig, {})[0].scene}
        return super().load(env, trusted, precision)

    def stored(self, scene: Scene | None, trusted: Collection[str]) -> Stored:
        """Reads the file."""
        from flowrep.agent import load_checkpoint

        path = _pretrained(scene) if self.name == "pretrained" else Path(self.name)
        state = load_checkpoint(path, ["config", "frames", "policy"])
        return validated_run(state["config"], path.name, trusted), state, path


def _check_not_typed(asked: Scene, kept: Scene) -> None:
    """Checks that the command's line sets no key of a scene that an agent keeps as it was."""
    keys = tuple(typed_keys() - {"scene"})
    for key, value, trained in differences({"scene": asdict(asked)}, {"scene": asdict(kept)}):
        if key.startswith(keys):
            raise UsageError(f"{key}={value}: leave it out: agents keep their training's {trained}")


def _check_is_there(name: str, file: str) -> None:
    if not Path(file).is_file():
        raise UsageError(f"policy={name}: there is no file '{file}'")


def _pretrained(scene: Scene | None) -> Path:
    assert scene is not None
    files = {file.stem: file for file in PRETRAINED.glob("*.safetensors")}
    if scene.name not in files:
        there = closest_first(scene.name, files)
        raise UsageError(
            f"no agent for scene '{scene.name}' comes with flowrep; there are: {there}"
        )
    return files[scene.name]


_SCALE = ".scale"


def packed(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns matrices and filters as int8 with a scale for each row, other weights unchanged.

    A weight is rounded to 1/127 of the largest in its row. That is coarser than bfloat16, in which
    agents compute; README.md of the pretrained agents gives the success of one with and without it.
    """
    import torch

    stored = {}
    for name, weight in weights.items():
        stored[name] = weight
        if weight.is_floating_point() and weight.ndim > 1:
            scale = weight.flatten(1).abs().amax(1) / 127
            # A row of zeros has the scale 0, and 0 / 0 would be nan.
            columns = scale.clamp(min=1e-12).view(-1, *[1] * (weight.ndim - 1))
            stored[name] = (weight / columns).round().to(torch.int8)
            stored[name + _SCALE] = scale
    return stored


def unpacked(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the weights that `packed` stored; others are unchanged.

    >>> import torch
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


def _env_config(given: Mapping[str, Any]) -> EnvConfig:
    """Returns the config of an env for a policy without one: `given`, and the defaults of conf/."""
    maps = given.get("representations", {})
    if isinstance(maps, str):
        raise UsageError(f"representations: give a list, ['{maps}']")
    if isinstance(maps, Mapping):
        defaults, _ = composed(TrainConfig, {})
        options = {name: _whole_options(name) | (maps[name] or {}) for name in maps}
        given = {**given, "representations": options or defaults.representations}
    else:
        defaults, _ = composed(TrainConfig, {"representations": [*maps]})
        given = {**given, "representations": defaults.representations}
    return validated(
        EnvConfig, {key: getattr(defaults, key) for key in EnvConfig.model_fields} | given
    )


def _whole_options(name: str) -> dict[str, Any]:
    """Returns a representation's options with their defaults, none for one of the user's."""
    from flowrep.transforms.representations import REPRESENTATIONS, representation_options

    return representation_options(name) if name in REPRESENTATIONS else {}


# Policies from other projects.


class PolicyError(Exception):
    """A policy from another project is no function, or returns no actions."""


@dataclass(frozen=True)
class Task:
    """What a policy from another project gets to know about its task."""

    scene: str
    representations: Mapping[str, Any]  # options by name, in the requested order
    observation_spec: Composite  # of the maps of one environment, `[C, H, W]` each
    action_spec: TensorSpec  # of one environment: 0 goes straight on, 1 turns left, 2 turns right
    intrinsics: Tensor  # K `[3, 3]` of the maps, pixels
    device: torch.device  # of the maps


class ForeignPolicy(NamedPolicy):
    """A policy from another project: path.py:make or package.module:make.

    `make` is a function that takes the task and returns the policy's function.
    """

    takes = (*NamedPolicy.takes, "representations", "flow", "motion", "noise")

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.module, _, self.function = name.rpartition(":")
        if self.module.endswith(".py"):
            _check_is_there(name, self.module)

    def load(self, env: Mapping[str, Any], trusted: Collection[str], precision: Any) -> Loaded:
        """Returns the policy, built for the task in the env."""
        import torch
        from torchrl.data import Composite

        from flowrep.envs import street_envs
        from flowrep.experiment import build

        given = self._given({**env, "precision": precision})
        if not given.get("representations"):
            raise UsageError(f"representations needs a value for policy={self.name}")
        config = _env_config(given)
        with closing(build.env(config, num_envs=1)) as street:
            maps = {name: street.observation_spec[name][0] for name in config.representations}
            task = Task(
                scene=config.scene.name,
                representations=config.representations,
                observation_spec=Composite(maps),
                action_spec=street.action_spec[0],
                intrinsics=torch.from_numpy(street_envs(street)[0].K),
                device=street.device,
            )
        return self.built_for(task), config, 0, None

    def built_for(self, task: Task) -> ForeignFunction:
        """Returns the policy for a task."""
        with _naming_policy(self.name):
            module = _module(self.module)
            if not hasattr(module, self.function):
                raise UsageError(f"policy={self.name}: {self.module} has no {self.function}")
            act = getattr(module, self.function)(task)
        if not callable(act):
            what = f"{self.function}(task) returned a {type(act).__name__}"
            raise PolicyError(f"policy '{self.name}': {what}, not a function of a TensorDict")
        return ForeignFunction(self.name, act, task)


class ForeignFunction:
    """Writes `action` `[N]`, computed by a function from another project.

    The function takes a TensorDict of batch `[N]` with the task's maps `[N, C, H, W]` and, for
    policies with a memory, `env_id` int64 `[N]`, the env of each row, and `is_init` bool `[N, 1]`,
    whether its episode just began. It returns N integers (a tensor, an array or a list), or the
    TensorDict with `action`.
    """

    def __init__(self, name: str, act: Callable[[TensorDictBase], Any], task: Task) -> None:
        self.name, self._act, self._task = name, act, task

    def __call__(self, maps: TensorDictBase) -> TensorDictBase:
        """Returns the maps with `action`."""
        import torch
        from tensordict import TensorDictBase

        # A copy, since the env reads the maps again if the policy changes them.
        seen = maps.select(*self._task.representations, "env_id", "is_init").clone()
        with _naming_policy(self.name):
            given = self._act(seen)
        if isinstance(given, TensorDictBase):
            given = given.get("action")
        n = int(self._task.action_spec.space.n)
        try:
            actions = torch.as_tensor(given).double().cpu()  # `isin` takes no bool
        except (TypeError, ValueError, RuntimeError):  # None, for instance
            actions = torch.empty(0)
        if actions.shape != maps.batch_size or not torch.isin(actions, torch.arange(n)).all():
            raise PolicyError(
                f"policy '{self.name}' returned {given!s:.200}; expected {len(maps)} whole numbers "
                f"from 0 to {n - 1}, one action per environment"
            )
        return maps.set("action", actions.long())


_FOLDERS: set[Path] = set()  # of the scripts that were loaded


def _module(name: str) -> Any:
    if not name.endswith(".py"):
        return import_module(name)
    path = Path(name).resolve()
    # Under a name that an earlier script imported, Python would give this one the same module.
    for loaded, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "/")
        if {file.parent, file.parent.parent} & (_FOLDERS - {path.parent}):
            del sys.modules[loaded]
    _FOLDERS.add(path.parent)
    sys.path.insert(0, str(path.parent))  # as Python does for a script
    spec = spec_from_file_location(f"flowrep_policy_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module


@contextmanager
def _naming_policy(name: str) -> Iterator[None]:
    """Names the policy above the traceback of an exception in its code, which its author needs."""
    try:
        yield
    except (UsageError, ImportError):  # a line says all
        raise
    except Exception as error:
        raise RuntimeError(f"policy '{name}' failed") from error
