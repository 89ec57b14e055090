"""Policies from other projects: scripts, modules and programs, and agents that were exported."""

import json
import logging
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

PROGRAM, CARD, LOADER = "agent.pt2", "agent.json", "load_agent.py"
"""The files of an exported agent: its program, the description of its maps, and their loader."""

_LIBRARIES = (
    sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), str(Path(__file__).parents[1]),
    "<frozen ",
)  # fmt: skip
"""Prefixes of the names of files that the author of a policy didn't write."""

_FOLDERS: set[Path] = set()  # of the scripts that were loaded


class PolicyError(Exception):
    """A policy from another project is missing, fails or returns no actions."""


@dataclass(frozen=True)
class Task:
    """What a policy from another project gets to know about its task."""

    scene: str
    representations: Mapping[str, Any]  # options by name, in the requested order
    observation_spec: Composite  # of the maps of one environment, `[C, H, W]` each
    action_spec: TensorSpec  # of one environment: 0 goes straight on, 1 turns left, 2 turns right
    intrinsics: Tensor  # K `[3, 3]` of the maps, pixels
    device: torch.device  # of the maps


class ExternalPolicy:
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
        # A copy, since the env reads the maps again if the policy changes them.
        seen = maps.select(*self._task.representations, "env_id", "is_init").clone()
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

    The reference is `path.py:make` or `package.module:make`, a function that takes the task and
    returns the policy's function; or `path.pt2`, a program saved by `torch.export.save` that takes
    the maps as arguments and returns a score per action. The arguments have the task's order or,
    for an agent that flowrep exported, the order in its agent.json.
    """
    with _named(reference):
        if reference.endswith(".pt2"):
            return ExternalPolicy(reference, _program(reference, task), task)
        module, _, name = reference.rpartition(":")
        act = getattr(_module(module), name)(task)
        if not callable(act):
            raise PolicyError(
                f"{name}(task) returned a {type(act).__name__}; expected a function of a "
                "TensorDict of maps"
            )
    return ExternalPolicy(reference, act, task)


def _module(name: str) -> Any:
    if not name.endswith(".py"):
        return import_module(name)
    path = Path(name).resolve(strict=True)
    folder = path.parent
    # Under a name that an earlier script imported, Python would give this one the same module.
    for loaded, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "/")
        if not {file.parent, file.parent.parent} & (_FOLDERS - {folder}):
            continue
        for same in (folder / f"{loaded}.py", folder / loaded / "__init__.py"):
            if same.is_file() and not same.samefile(file):
                raise PolicyError(
                    f"would import {file} instead of {same}: evaluate the two policies in separate "
                    "commands"
                )
    _FOLDERS.add(folder)
    sys.path.insert(0, str(folder))  # as Python does for a script
    spec = spec_from_file_location(f"flowrep_policy_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module


def _program(path: str, task: Task) -> Callable[[TensorDictBase], Tensor]:
    Path(path).resolve(strict=True)
    logger = logging.getLogger("torch.export")  # prints the traceback of a damaged file
    was_disabled, logger.disabled = logger.disabled, True
    try:
        loaded = torch.export.load(path)
    except Exception as error:
        raise PolicyError(
            "is damaged, or was not saved by torch.export.save of this PyTorch; save it again"
        ) from error
    finally:
        logger.disabled = was_disabled
    # Moving only the module would not change the devices that are written in its graph.
    program = move_to_device_pass(loaded, task.device).module()
    card = _card(path)
    names = task.representations if card is None else [each["name"] for each in card["maps"]]
    return lambda maps: program(*(maps[name] for name in names)).argmax(-1)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Turns an exception in a policy's code into a PolicyError: one line, with file and line."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"policy '{name}': {error}") from error.__cause__
    except Exception as error:
        text = str(error).strip().splitlines()
        # The last line that the author wrote, rather than one deep in a library.
        frames = traceback.extract_tb(error.__traceback__)
        theirs = [frame for frame in frames if not frame.filename.startswith(_LIBRARIES)]
        where = f" ({theirs[-1].filename}, line {theirs[-1].lineno})" if theirs else ""
        raise PolicyError(
            f"policy '{name}' failed: {type(error).__name__}: {text[0] if text else ''}{where}"
        ) from error


def check_card(reference: str, task: Task) -> None:
    """Checks that an exported agent gets maps like those of its training.

    A policy without an agent.json beside it passes. The error lists the overrides that give the
    right maps.
    """
    with _named(reference):
        card = _card(reference)
        if card is None:
            return
        trained, here = _settings(card, task)
    if wrong := [key for key in trained if trained[key] != here[key]]:
        raise PolicyError(
            f"policy '{reference}' was not trained on the maps of {_overrides(here, wrong)}; give "
            f"{_overrides(trained, wrong)}"
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
            raise PolicyError(
                f"{path.with_name(name)} was damaged or changed after its export; export the agent "
                "again"
            )
    return card


def _settings(card: Mapping[str, Any], task: Task) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the settings that the maps depend on, by override key: in training, and here."""
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
        spec, channels = task.observation_spec[name], maps[name]["shape"][0]
        has_other_ids = isinstance(spec, Categorical) and spec.n != card["num_classes"]
        if has_other_ids or spec.shape[0] != channels:
            trained["scene"], here["scene"] = card["scene"], task.scene
    return trained, here


def _camera(shape: Sequence[int], K: Sequence[Sequence[float]]) -> dict[str, Any]:
    height, width = shape[-2:]
    fov_deg = 2 * math.degrees(math.atan(height / 2 / K[1][1]))
    size = {"scene.camera.height_px": height, "scene.camera.width_px": width}
    return size | {"scene.camera.fov_deg": round(fov_deg, 3)}


def _overrides(settings: Mapping[str, Any], keys: Sequence[str]) -> str:
    """Returns settings as overrides, `representations=[ego,obj] scene=s_turn`."""
    texts = [f"{key}={json.dumps(settings[key], separators=(',', ':'))}" for key in keys]
    plain = [text.replace('"', "") for text in texts]
    # Quoted, since the card may be a stranger's and the line may be pasted into a shell.
    return " ".join(x if re.fullmatch(r"[\w.=,\[\]-]+", x) else shlex.quote(x) for x in plain)
