"""A trained policy as a program of torch's own, that runs where flowrep is not."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch.export import Dim, ExportedProgram
from torchrl.data import Composite

from flowrep.agent.policy import PolicyNetwork
from flowrep.exchange import load_agent

PROGRAM, WEIGHTS, CARD, LOADER = "agent.pt2", "agent.safetensors", "agent.json", "load_agent.py"


class ExportError(ValueError):
    """A policy has no form in which it could be given away; the message says why."""


def acting_program(policy: torch.nn.Module, observation_spec: Composite) -> ExportedProgram:
    """Returns the network of a policy, traced: maps `[N, C, H, W]` in, a score an action out.

    The maps are arguments in the policy's order, of the types that the specs have; N is any number.
    The greedy action has the largest score. Of policies that draw, the scores are logits.

    Args:
        policy: of one of flowrep's algorithms.
        observation_spec: of the env that it was built for.

    Raises:
        ExportError: it is not made of one `PolicyNetwork`.
    """
    networks = [module for module in policy.modules() if isinstance(module, PolicyNetwork)]
    if len(networks) != 1:
        raise ExportError(
            f"a policy is exported by its flowrep.agent.policy.PolicyNetwork, of which "
            f"{type(policy).__name__} has {len(networks)}; build it by acting_network()"
        )
    (network,) = networks
    maps = []
    for codec in network.codecs:
        size = (2, codec.channels, codec.height, codec.width)
        maps.append(torch.zeros(size, dtype=observation_spec[codec.key].dtype))
    any_number = {0: Dim("batch")}
    with torch.no_grad():
        return torch.export.export(
            network.cpu().eval(), tuple(maps), dynamic_shapes=((any_number,) * len(maps),)
        )


def write_agent(folder: Path, program: ExportedProgram, card: Mapping[str, Any]) -> None:
    """Writes what others need to run an agent.

    ```
    agent.pt2            the program, for torch.export.load
    agent.safetensors    its weights alone, those of ordinary convolutions and linear layers
    agent.json           what it reads and what its actions are
    load_agent.py        reads the first and the third; needs torch alone
    ```

    Args:
        folder: is made if it does not exist.
        program: from `acting_program`.
        card: what goes into agent.json.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.export.save(program, folder / PROGRAM)
    weights = {name: weight.detach().contiguous() for name, weight in program.state_dict.items()}
    save_file(weights, folder / WEIGHTS)
    (folder / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    shutil.copyfile(load_agent.__file__, folder / LOADER)
