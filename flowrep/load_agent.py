"""Loads an agent trained by flowrep, with torch alone, from agent.pt2 and agent.json beside it."""

import json
import zlib
from pathlib import Path

import torch
from torch.export.passes import move_to_device_pass

HERE = Path(__file__).parent


def make(task=None, device="cpu"):
    """Returns a function from maps by name, tensors [N, C, H, W], to actions [N].

    The maps are on `device`, or on that of flowrep's task.
    """
    card = json.loads((HERE / "agent.json").read_text())
    if wrong := damaged(HERE, card):
        raise ValueError(f"{HERE}: {', '.join(wrong)} not as exported; export the agent again")
    program = torch.export.load(HERE / "agent.pt2")
    network = move_to_device_pass(program, task.device if task else device).module()
    names = [each["name"] for each in card["maps"]]
    return lambda maps: network(*(maps[name] for name in names)).argmax(-1)


def damaged(folder, card):
    """Returns the names of files in the folder that are not what the card has the CRC-32 of."""
    rest = {key: value for key, value in card.items() if key != "crc32"}
    digests = card.get("crc32", {})  # exports of earlier versions have none
    here = {name: (folder / name).read_bytes() for name in digests if (folder / name).is_file()}
    here["agent.json"] = json.dumps(rest).encode()
    return [name for name in digests if name in here and zlib.crc32(here[name]) != digests[name]]
