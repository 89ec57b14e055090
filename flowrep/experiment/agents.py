"""Agents to evaluate, film or view: those of runs, and policies of the user's own."""

import json
import math
import re
import shlex
import sys
import sysconfig
import traceback
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.export.passes import move_to_device_pass
from torchrl.data import Categorical, Composite, TensorSpec
from torchrl.envs import EnvBase

from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.config.schema import EnvConfig, TrainConfig
from flowrep.envs import street_envs
from flowrep.experiment import build
from flowrep.experiment.evaluation import Policy, scene_id
from flowrep.experiment.run import RunFolder, check_origin, origin_of
from flowrep.scenes import load_scene

PROGRAM, CARD, LOADER = "agent.pt2", "agent.json", "load_agent.py"
"""The files of an exported agent: the program that runs it, what describes it, what loads it."""

_NOT_THE_USERS = (
    sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), str(Path(__file__).parents[1]),
    "<frozen ",
)  # fmt: skip
"""Beginnings of the names of files with other people's code."""


@dataclass(frozen=True)
class Agent:
    """A policy and the env in which it acts."""

    policy: Policy | str  # writes `action`; or a baseline's name
    config: EnvConfig
    frames: int = 0  # that it was trained for; 0 if unknown
    trained_in: str | None = None  # the name of a scene, None if unknown

    def make_env(self, **changes: Any) -> EnvBase:
        """Returns an env of its config, with changes of `make_env`'s arguments."""
        num_envs = changes.get("num_envs", self.config.num_envs)
        workers = {"num_workers": build.evaluation_workers(self.config, num_envs)}
        return build.env(self.config, **workers | changes)

    def origin(self, evaluation: str) -> dict[str, Any]:
        """Returns the columns of evaluation.csv that tell which agent drove where."""
        scene = load_scene(self.config.scene)
        return {
            "scene": scene.name,
            "scene_id": scene_id(scene),
            "representations": "+".join(self.config.representations),
            "flow": self.config.flow.source,
            "seed": self.config.seed if self.frames else "",
            "frames": self.frames,
            "evaluation": evaluation,
        }


def load_trained(
    run: RunFolder,
    *,
    scene: Mapping[str, Any] | None = None,
    algorithm: str | None = None,
    **machine: Any,
) -> Agent:
    """Returns a run's agent, to act in the given scene, or in its own if None.

    `machine` is `device`, `num_envs` and `num_workers`, in place of the run's; `algorithm` is one
    that it may name besides flowrep's own.
    """
    own = run.config(algorithm)
    path = run.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own.plain()), path)
    return with_weights(
        own, state["policy"], state["frames"], f"the agent of {run.path}", scene=scene, **machine
    )


def with_weights(
    own: TrainConfig,
    weights: Mapping[str, Tensor],
    frames: int,
    name: str,
    *,
    scene: Mapping[str, Any] | None = None,
    **machine: Any,
) -> Agent:
    """Returns the agent of a run's config with these weights; `name` is for messages."""
    if scene is not None:
        machine["scene"] = {**scene, "camera": own.scene["camera"]}
    config = own.model_copy(update=machine)
    env = build.env(config, num_envs=1, num_workers=0)
    policy = build.policy(config, env)
    env.close()
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"{name} can't be used in scene '{config.scene['name']}', which has other classes "
            f"than its own ({reason})"
        ) from error
    return Agent(policy, config, frames, own.scene["name"])


def load_external(reference: str, config: EnvConfig) -> Agent:
    """Returns a policy of the user's own, in the env of the config."""
    env = build.env(config, num_envs=1, num_workers=0)
    task = Task(
        scene=config.scene["name"],
        representations=config.representations,
        observation_spec=Composite(
            {name: env.observation_spec[name][0] for name in config.representations}
        ),
        action_spec=env.action_spec[0],
        intrinsics=torch.from_numpy(street_envs(env)[0].K),
        device=build.device(config.device),
    )
    env.close()
    check_card(reference, task)
    return Agent(load_policy(reference, task), config)


class PolicyError(Exception):
    """An external policy is missing, fails or returns no actions; the message names it."""


@dataclass(frozen=True)
class Task:
    """The task, as described to the function that makes an external policy."""

    scene: str
    representations: Mapping[str, Any]  # options by name, in the requested order
    observation_spec: Composite  # of the maps of one environment, `[C, H, W]` each
    action_spec: TensorSpec  # of one environment: 0 goes straight on, 1 turns left, 2 turns right
    intrinsics: Tensor  # K `[3, 3]` of the maps, pixels
    device: torch.device  # of the maps


class ExternalPolicy:
    """Writes `action` `[N]`, computed by an external function.

    The function takes a TensorDict of batch `[N]` that holds only the task's maps `[N, C, H, W]`,
    `env_id` int64 `[N]` and `is_init` bool `[N, 1]`, for policies that remember: each row's
    environment, and whether its episode just began. It returns N integers (a tensor, an array or a
    list), or the TensorDict with `action`.
    """

    def __init__(self, name: str, act: Callable[[TensorDictBase], Any], task: Task) -> None:
        self.name, self._act, self._task = name, act, task

    def __call__(self, maps: TensorDictBase) -> TensorDictBase:
        """Returns the maps with `action`."""
        seen = maps.select(*self._task.representations, "env_id", "is_init")
        with _named(self.name):
            given = self._act(seen)
        if isinstance(given, TensorDictBase):
            given = given.get("action")
        n = int(self._task.action_spec.space.n)
        try:
            actions = torch.as_tensor(given).cpu()
            whole = actions.long()
            if actions.shape != maps.batch_size:
                what = f"{actions.dtype} of shape {tuple(actions.shape)}"
            elif ((whole == actions) & (whole >= 0) & (whole < n)).all():
                return maps.set("action", whole)
            else:
                what = str(actions.tolist())
        except (TypeError, ValueError, RuntimeError):
            what = f"a {type(given).__name__}"
        raise PolicyError(
            f"policy '{self.name}' returned {what}; expected {len(maps)} whole numbers from 0 to "
            f"{n - 1}, one action per environment"
        )


def load_policy(reference: str, task: Task) -> ExternalPolicy:
    """Returns the policy that a reference names.

    It is `path.py:make` or `package.module:make`, a function that is called with the task and
    returns the policy's function; or `path.pt2`, a program saved by `torch.export.save` that takes
    the maps as arguments, in the task's order (that of flowrep's export in the order of its
    agent.json), and returns a score per action.
    """
    with _named(reference):
        if reference.endswith(".pt2"):
            return ExternalPolicy(reference, _program(reference, task), task)
        place, _, name = reference.rpartition(":")
        act = getattr(_module(place), name)(task)
        if not callable(act):
            raise PolicyError(
                f"{name}(task) returned a {type(act).__name__}; expected a function of a "
                "TensorDict of maps"
            )
    return ExternalPolicy(reference, act, task)


def _module(place: str) -> Any:
    if not place.endswith(".py"):
        return import_module(place)
    path = Path(place).resolve(strict=True)
    sys.path.insert(0, str(path.parent))  # as Python does for a script
    spec = spec_from_file_location(f"flowrep_policy_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module


def _program(path: str, task: Task) -> Callable[[TensorDictBase], Tensor]:
    # moving the module alone would leave the devices that its graph names
    program = move_to_device_pass(torch.export.load(path), task.device).module()
    card = _card(path)
    names = task.representations if card is None else [each["name"] for each in card["maps"]]
    return lambda maps: program(*(maps[name] for name in names)).argmax(-1)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Turns any exception in external code into a PolicyError of one line, with its location."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"policy '{name}': {error}") from error.__cause__
    except Exception as error:
        text = str(error).strip().splitlines()
        # the last line of the author's own code, rather than one deep in a library
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if not frame.filename.startswith(_NOT_THE_USERS)]
        place = f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""
        raise PolicyError(
            f"policy '{name}' failed: {type(error).__name__}: {text[0] if text else ''}{place}"
        ) from error


def check_card(reference: str, task: Task) -> None:
    """Checks that an exported agent gets maps like those that it was trained on.

    What has no agent.json beside it passes. The error has the overrides that give the right maps.
    """
    with _named(reference):
        card = _card(reference)
        if card is None:
            return
        trained, here = _settings(card, task)
    if wrong := [key for key in trained if trained[key] != here[key]]:
        raise PolicyError(
            f"policy '{reference}' was trained on other maps than those of "
            f"{_overrides(here, wrong)}; give {_overrides(trained, wrong)}"
        )


def _card(reference: str) -> Any:
    """Returns the content of an exported agent's agent.json, None for other policies."""
    agent = Path(reference.removesuffix(":make"))
    path = agent.with_name(CARD) if agent.name in (PROGRAM, LOADER) else None
    if path is None or not path.is_file():
        return None
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise PolicyError(f"{path} is damaged: {error}; export the agent again") from error
    digests = card.pop("crc32", {})  # exports of earlier versions have none
    for name in digests.keys() & {CARD, PROGRAM}:
        data = json.dumps(card).encode() if name == CARD else path.with_name(name).read_bytes()
        if zlib.crc32(data) != digests[name]:
            raise PolicyError(f"{path.with_name(name)} is not as exported; export the agent again")
    return card


def _settings(card: Mapping[str, Any], task: Task) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what the maps depend on, by its key on the command line: in training, and here."""
    maps = {each["name"]: each for each in card["maps"]}
    shape = task.observation_spec[next(iter(task.representations))].shape
    trained = _camera(card["maps"][0]["shape"], card["intrinsics"])
    here = _camera(shape, task.intrinsics.tolist())
    if maps.keys() - task.representations.keys():
        trained["representations"], here["representations"] = list(maps), list(task.representations)
    for name in maps.keys() & task.representations.keys():
        for option, value in maps[name]["options"].items():
            key = f"representations.{name}.{option}"
            trained[key], here[key] = value, task.representations[name].get(option)
        spec = task.observation_spec[name]
        if isinstance(spec, Categorical) and spec.n != card["num_classes"]:
            trained["scene"], here["scene"] = card["scene"], task.scene
    return trained, here


def _camera(shape: Sequence[int], K: Sequence[Sequence[float]]) -> dict[str, Any]:
    height, width = shape[-2:]
    fov_deg = 2 * math.degrees(math.atan(height / 2 / K[1][1]))
    size = {"scene.camera.height_px": height, "scene.camera.width_px": width}
    return size | {"scene.camera.fov_deg": round(fov_deg, 3)}


def _overrides(settings: Mapping[str, Any], keys: Sequence[str]) -> str:
    """Returns settings as on the command line, `representations=[ego,obj] scene=s_turn`."""
    texts = [f"{key}={json.dumps(settings[key], separators=(',', ':'))}" for key in keys]
    plain = [text.replace('"', "") for text in texts]
    # what a card from somebody else says may be pasted into a shell
    return " ".join(x if re.fullmatch(r"[\w.=,\[\]-]+", x) else shlex.quote(x) for x in plain)
