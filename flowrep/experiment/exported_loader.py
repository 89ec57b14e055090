"""Loads an agent that flowrep trained from agent.pt2 and agent.json beside it; needs only torch."""

import io
import json
import zlib
from pathlib import Path

import torch
from torch.export.passes import move_to_device_pass

HERE = Path(__file__).parent


def make(task=None, device="cpu"):
    """Returns a function from maps by name, tensors [N, C, H, W], to actions [N].

    The maps are on `device`; flowrep passes a task, whose device replaces it.
    """
    card = json.loads((HERE / "agent.json").read_text())
    saved = (HERE / "agent.pt2").read_bytes()
    if zlib.crc32(saved) != card["crc32"]["agent.pt2"]:
        raise ValueError(f"{HERE / 'agent.pt2'} is damaged, or of another export than agent.json")
    program = torch.export.load(io.BytesIO(saved))
    network = move_to_device_pass(program, task.device if task else device).module()
    names = [each["name"] for each in card["maps"]]
    return lambda maps: network(*(maps[name] for name in names)).argmax(-1)
