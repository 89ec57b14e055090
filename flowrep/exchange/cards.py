"""An exported agent's agent.json against the maps that it is to be evaluated on."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl.data import Categorical

from flowrep.exchange.policies import PolicyError, Task
from flowrep.exchange.programs import CARD, LOADER, PROGRAM


def check_card(reference: str, task: Task) -> None:
    """Checks that an exported agent gets maps like those that it was trained on.

    A policy that isn't `agent.pt2` or `load_agent.py` with an `agent.json` beside it passes.

    Args:
        reference: of the policy, see `load_policy`.
        task: the policy's task.

    Raises:
        PolicyError: the maps differ in what they are, in size, field of view, options or classes;
            the message has the overrides that give the right ones. Or agent.json is damaged.
    """
    agent = Path(reference.removesuffix(":make"))
    path = agent.parent / CARD
    if agent.name not in (PROGRAM, LOADER) or not path.is_file():
        return
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
        trained, here = _settings(card, task, any_order=agent.name == LOADER)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise PolicyError(
            f"policy '{reference}': {path} doesn't describe an exported agent "
            f"({type(error).__name__}: {error}); export it again"
        ) from error
    if wrong := [key for key in trained if trained[key] != here[key]]:
        raise PolicyError(
            f"policy '{reference}' was trained on other maps than those of "
            f"{_overrides(here, wrong)}; give {_overrides(trained, wrong)}"
        )


def _settings(
    card: Mapping[str, Any], task: Task, *, any_order: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what the maps depend on, by its key on the command line: in training, and here."""
    maps = {each["name"]: each for each in card["maps"]}
    shown = [name for name in maps if name in task.representations]
    suffices = any_order and shown == list(maps)
    trained: dict[str, Any] = {"representations": list(maps)}
    here: dict[str, Any] = {"representations": shown if suffices else list(task.representations)}
    shape = task.observation_spec[next(iter(task.representations))].shape
    trained |= _camera(card["maps"][0]["shape"], card["intrinsics"])
    here |= _camera(shape, task.intrinsics.tolist())
    for name in shown:
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
    texts = {key: json.dumps(settings[key], separators=(",", ":")) for key in keys}
    return " ".join(f"{key}={text}" for key, text in texts.items()).replace('"', "")
