"""Messages about overrides that Hydra refuses."""

from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from flowrep.config.violations import closest


def unknown_choice(group: str, name: str, options: Sequence[str]) -> str:
    """Returns the message that a group has no such choice, with its choices.

    >>> unknown_choice("scene", "s_turm", ["s_turn", "straight_road"])
    "unknown scene 's_turm' (did you mean 's_turn'?); there are: s_turn, straight_road"
    """
    known = sorted(options)
    return f"unknown {group} '{name}'{closest(name, known)}; there are: {', '.join(known)}"


def needs_a_choice(group: str, options: Sequence[str]) -> str:
    """Returns the message that nothing of a group was chosen, with its choices.

    >>> needs_a_choice("format", ["tum", "frames"])
    "'format' needs a value: format=...; there are: frames, tum"
    """
    return f"'{group}' needs a value: {group}=...; there are: {', '.join(sorted(options))}"


def unknown_key(key: str, config: DictConfig, groups: Sequence[str]) -> str | None:
    """Walks a dotted key down a config; returns the message about a part that doesn't exist.

    Args:
        key: the key as typed, e.g. "scene.camera.heigth_px".
        config: the config composed without the override of that key.
        groups: the groups whose choices are overridden by their name.
    """
    node: Any = config
    parts = key.split(".")
    if parts[0] == "hydra":
        return None
    for depth, part in enumerate(parts):
        known = [str(name) for name in node] if isinstance(node, DictConfig) else []
        if not depth:
            known = [name for name in dict.fromkeys([*known, *groups]) if name != "hydra"]
        if part not in known:
            where = f" of '{'.'.join(parts[:depth])}'" if depth else ""
            there = f"there are: {', '.join(known)}" if known else "it has no keys"
            return f"unknown key '{part}'{where}{closest(part, known)}; {there}"
        node = OmegaConf.select(node, part) if isinstance(node, DictConfig) else None
    return None


def one_line(error: Exception) -> str:
    """Returns the message of Hydra or OmegaConf, without the lines on the place in the config."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    place = ("full_key:", "object_type=", "See http", "Config search path:")
    return " ".join([line for line in lines if not line.startswith(place)][:2])
