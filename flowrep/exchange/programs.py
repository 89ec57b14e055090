"""Exports a trained policy as a torch program, which runs without flowrep."""

import copy
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch.export import Dim, ExportedProgram
from torchrl.data import Composite

from flowrep.agent.networks import PolicyNetwork
from flowrep.exchange import load_agent

PROGRAM, WEIGHTS, CARD, LOADER = "agent.pt2", "agent.safetensors", "agent.json", "load_agent.py"


class ExportError(ValueError):
    """A policy can't be exported; the message says why."""


def acting_program(policy: torch.nn.Module, observation_spec: Composite) -> ExportedProgram:
    """Returns a policy's traced network, from maps `[N, C, H, W]` to one score per action.

    The maps are arguments in the policy's order, with the dtypes of the specs, for any N. The
    greedy action has the largest score. For stochastic policies, the scores are logits.

    Args:
        policy: of one of flowrep's algorithms; it is left as it is.
        observation_spec: of the env that the policy was built for.

    Raises:
        ExportError: if the policy doesn't contain exactly one `PolicyNetwork`.
    """
    networks = [module for module in policy.modules() if isinstance(module, PolicyNetwork)]
    if len(networks) != 1:
        raise ExportError(
            f"a policy is exported through its one flowrep.agent.networks.PolicyNetwork, of which "
            f"{type(policy).__name__} has {len(networks)}; build it with acting_network()"
        )
    (network,) = networks
    maps = []
    for codec in network.codecs:
        size = (2, codec.channels, codec.height, codec.width)
        maps.append(torch.zeros(size, dtype=observation_spec[codec.key].dtype))
    any_number = {0: Dim("batch")}
    with torch.no_grad():
        return torch.export.export(
            copy.deepcopy(network).cpu().eval(),
            tuple(maps),
            dynamic_shapes=((any_number,) * len(maps),),
        )


def write_agent(folder: Path, program: ExportedProgram, card: Mapping[str, Any]) -> None:
    """Writes the files needed to run an agent without flowrep.

    ```
    agent.pt2            the program, for torch.export.load
    agent.safetensors    only its weights, those of ordinary convolutions and linear layers
    agent.json           its inputs and actions
    load_agent.py        loads agent.pt2 and agent.json; needs only torch
    ```

    Args:
        folder: created if it does not exist.
        program: from `acting_program`.
        card: contents of agent.json.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.export.save(program, folder / PROGRAM)
    weights = {name: weight.detach().contiguous() for name, weight in program.state_dict.items()}
    save_file(weights, folder / WEIGHTS)
    (folder / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    shutil.copyfile(load_agent.__file__, folder / LOADER)
