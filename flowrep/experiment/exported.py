"""An agent as files that can be used without flowrep; `exported_loader.py` is one of them."""

from __future__ import annotations

import copy
import io
import json
import zlib
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch.export import Dim, ExportedProgram
from torchrl.data import Composite

from flowrep import __version__
from flowrep.agent.networks import PolicyNetwork
from flowrep.envs import street_envs
from flowrep.experiment import exported_loader
from flowrep.experiment.evaluation import Driver
from flowrep.experiment.external import CARD, LOADER, PROGRAM
from flowrep.files import replace_files

ACTIONS = ("no_op", "turn_left", "turn_right")  # in the order of flowrep.scenes.vehicle


class ExportError(ValueError):
    """A policy can't be exported."""


def export(agent: Driver, folder: Path) -> None:
    """Writes a trained agent; load it with `precision="fp32"`, which runs fast on any machine."""
    config: Any = agent.config
    with closing(agent.make_env(num_envs=1, num_workers=0)) as env:
        spec, (street,) = env.observation_spec, street_envs(env)
        program = acting_program(agent.policy, spec)
    maps = [
        {
            "name": name,
            "shape": list(spec[name].shape[1:]),
            "dtype": str(spec[name].dtype).removeprefix("torch."),
            "options": options or {},
        }
        for name, options in config.representations.items()
    ]
    card = {
        "flowrep": __version__,
        "maps": maps,
        "actions": list(ACTIONS),
        "flow": config.flow.plain(),
        "noise": config.noise.plain(),
        "intrinsics": street.K.tolist(),
        "num_classes": street.num_classes,
        "frame_rate_hz": street.frame_rate_hz,
        "scene": config.scene.name,
        "algorithm": config.algorithm.plain(),
        "frames": agent.frames,
    }
    write_agent(folder, program, card)


def acting_program(policy: Any, observation_spec: Composite) -> ExportedProgram:
    """Returns a policy's traced network, from maps `[N, C, H, W]` to one score per action.

    The maps are arguments in the policy's order, with the dtypes of the specs, for any N. The
    greedy action has the largest score. For stochastic policies, the scores are logits.
    """
    networks = [module for module in policy.modules() if isinstance(module, PolicyNetwork)]
    if len(networks) != 1:
        raise ExportError(
            "only a policy with exactly one flowrep.agent.networks.PolicyNetwork can be exported; "
            f"{type(policy).__name__} has {len(networks)}: build it with acting_network()"
        )
    (network,) = networks
    specs = [observation_spec[codec.key] for codec in network.codecs]
    maps = tuple(torch.zeros(2, *spec.shape[-3:], dtype=spec.dtype) for spec in specs)
    any_number = ({0: Dim("batch")},) * len(maps)
    with torch.no_grad():
        traced = copy.deepcopy(network).cpu().eval()
        return torch.export.export(traced, maps, dynamic_shapes=(any_number,))


def write_agent(folder: Path, program: ExportedProgram, card: Mapping[str, Any]) -> None:
    """Writes the program, its weights, a loader that needs only torch, and, last, the card."""
    traced = io.BytesIO()
    torch.export.save(program, traced)
    weights = {name: weight.detach().contiguous() for name, weight in program.state_dict.items()}
    files = {PROGRAM: traced.getvalue(), "agent.safetensors": save(weights)}
    # Checksums reveal damage, which torch.export.load doesn't check for.
    digests = {name: zlib.crc32(data) for name, data in files.items()}
    digests[CARD] = zlib.crc32(json.dumps(dict(card)).encode())
    files[LOADER] = Path(exported_loader.__file__).read_bytes()  # no checksum: it may be edited
    files[CARD] = (json.dumps({**card, "crc32": digests}, indent=2) + "\n").encode()
    folder.mkdir(parents=True, exist_ok=True)
    replace_files(folder, files)
