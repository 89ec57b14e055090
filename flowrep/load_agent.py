"""Loads an agent trained by flowrep, with torch alone, from agent.pt2 and agent.json beside it."""

import json
from pathlib import Path

import torch
from torch.export.passes import move_to_device_pass

HERE = Path(__file__).parent


def make(task=None, device="cpu"):
    """Returns a function from maps by name, tensors [N, C, H, W], to actions [N].

    The maps are on `device`, or on that of flowrep's task.
    """
    names = [each["name"] for each in json.loads((HERE / "agent.json").read_text())["maps"]]
    program = torch.export.load(HERE / "agent.pt2")
    network = move_to_device_pass(program, task.device if task else device).module()
    return lambda maps: network(*(maps[name] for name in names)).argmax(-1)
