"""Trained agents that come with flowrep, one for each scene. README.md here is their card.

>>> agent = load("straight_road")
>>> env = agent.make_env(num_envs=2)
>>> env.rollout(3, agent.policy)["action"].shape
torch.Size([2, 3])
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flowrep.agent import load_checkpoint, save_checkpoint
from flowrep.config import UsageError
from flowrep.config.schema import validated_run
from flowrep.experiment.agents import Agent, with_weights
from flowrep.experiment.run import RunFolder

FOLDER = Path(__file__).parent
_SCALE = ".scale"


def load(scene: str | Mapping[str, Any], **machine: Any) -> Agent:
    """Returns the trained agent of a scene: its policy, and envs with what it sees.

    Args:
        scene: its name, or its definition with changes of your own.
        machine: `device`, `num_envs` and `num_workers` of its envs.

    Raises:
        UsageError: there is none for this scene.
    """
    name = scene if isinstance(scene, str) else scene["name"]
    files = {file.stem: file for file in FOLDER.glob("*.safetensors")}
    if name not in files:
        there = ", ".join(sorted(files))
        raise UsageError(f"no agent for scene '{name}' comes with flowrep; there are: {there}")
    stored = load_checkpoint(files[name])
    config = validated_run(stored["config"], files[name].name)
    here: dict[str, Any] = {"device": "auto", "num_workers": 0} | machine
    if not isinstance(scene, str):
        here["scene"] = scene
    weights = unpacked(stored["policy"])
    return with_weights(config, weights, stored["frames"], "the trained agent", **here)


def pack(run: str | Path, path: Path) -> None:
    """Writes the policy of a run and its config into one file, at a byte for each weight."""
    folder = RunFolder.existing(run)
    state = load_checkpoint(folder.checkpoint_path, ["frames", "policy"])
    stored = {"config": folder.read_config(), "policy": packed(state["policy"])}
    save_checkpoint(path, {"frames": state["frames"], **stored})


def packed(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns matrices and filters as int8, with a scale for each output; the rest as it is.

    A weight is rounded to 1/127 of the largest of its row, coarser than bfloat16, in which agents
    compute; README.md has the success with and without.
    """
    found = {}
    for name, weight in weights.items():
        found[name] = weight
        if weight.is_floating_point() and weight.ndim > 1:
            scale = weight.flatten(1).abs().amax(1) / 127
            columns = scale.clamp(min=1e-12).view(-1, *[1] * (weight.ndim - 1))
            found[name] = (weight / columns).round().to(torch.int8)
            found[name + _SCALE] = scale
    return found


def unpacked(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the weights that `packed` stored.

    >>> weights = {"weight": torch.tensor([[1.0, -0.5], [0.0, 0.0]])}
    >>> unpacked(packed(weights))["weight"]
    tensor([[ 1.0000, -0.5039],
            [ 0.0000,  0.0000]])
    """
    found = dict(stored)
    for name in [key for key in stored if key.endswith(_SCALE)]:
        scale, whole = found.pop(name), name.removesuffix(_SCALE)
        found[whole] = stored[whole] * scale.view(-1, *[1] * (stored[whole].ndim - 1))
    return found
