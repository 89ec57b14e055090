"""Loads an agent trained by flowrep, with torch alone, from agent.pt2 and agent.json beside it."""

import json
from pathlib import Path

import torch

HERE = Path(__file__).parent


def make(task=None):
    """Returns a function from maps by name, tensors [N, C, H, W], to actions [N]."""
    names = [each["name"] for each in json.loads((HERE / "agent.json").read_text())["maps"]]
    program = torch.export.load(HERE / "agent.pt2").module()
    return lambda maps: program(*(maps[name] for name in names)).argmax(-1)
