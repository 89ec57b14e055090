"""Exports a trained agent: `python -m flowrep.export run=outputs/...`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

import copy
import io
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrep.extras import require

require("an export", "train", "hydra", "pydantic", module=__name__)

from flowrep import __version__
from flowrep.config.cli import run_command
from flowrep.config.schema import ExportConfig, TrainConfig
from flowrep.files import replace_files

if TYPE_CHECKING:
    import torch
    from torch.export import ExportedProgram
    from torchrl.data import Composite
    from torchrl.envs import EnvBase

    from flowrep.experiment.run import RunFolder

ACTIONS = ("no_op", "turn_left", "turn_right")  # by their indices in flowrep.scenes.scene


def run(config: ExportConfig) -> None:
    """Writes the agent of a run as files that can be used without flowrep."""
    from flowrep.experiment.run import RunFolder

    folder = export(RunFolder.existing(config.run), config.output, config.algorithm.target)
    print(f"the agent is in {folder}; load_agent.py there shows how to run it")


def export(run: RunFolder, output: str | None = None, algorithm: str | None = None) -> Path:
    """Writes a run's agent, which computes in float32 on any machine; returns the folder.

    This is `output`, or `export` in the run's folder if None. `algorithm` is one that the run may
    name besides flowrep's own.
    """
    from flowrep.agent import load_checkpoint
    from flowrep.experiment import build
    from flowrep.experiment.run import check_origin, origin_of

    own = run.config(algorithm)
    state = load_checkpoint(run.checkpoint_path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own.plain()), run.checkpoint_path)
    section = own.algorithm
    if "precision" in section.options():
        section = section.model_copy(update={"precision": "fp32"})
    config = own.model_copy(update={"algorithm": section, "device": "cpu"})
    env = build.env(config, num_envs=1, num_workers=0)
    policy = build.policy(config, env)
    policy.load_state_dict(state["policy"])
    program = acting_program(policy, env.observation_spec)
    card = agent_card(config, env, state["frames"])
    env.close()
    folder = Path(output or run.path / "export")
    write_agent(folder, program, card)
    return folder


def agent_card(config: TrainConfig, env: EnvBase, frames: int) -> dict[str, Any]:
    """Returns the description that others need to give the agent its observations."""
    from flowrep.envs import street_envs

    spec, (street,) = env.observation_spec, street_envs(env)
    return {
        "flowrep": __version__,
        "maps": [
            {
                "name": name,
                "shape": list(spec[name].shape[1:]),
                "dtype": str(spec[name].dtype).removeprefix("torch."),
                "options": options or {},
            }
            for name, options in config.representations.items()
        ],
        "actions": list(ACTIONS),
        "flow": config.flow.plain(),
        "noise": config.noise.plain(),
        "intrinsics": street.K.tolist(),
        "num_classes": street.num_classes,
        "frame_rate_hz": street.frame_rate_hz,
        "scene": config.scene["name"],
        "algorithm": config.algorithm.plain(),
        "frames": frames,
    }


class ExportError(ValueError):
    """A policy can't be exported."""


def acting_program(policy: torch.nn.Module, observation_spec: Composite) -> ExportedProgram:
    """Returns a policy's traced network, from maps `[N, C, H, W]` to one score per action.

    The maps are arguments in the policy's order, with the dtypes of the specs, for any N. The
    greedy action has the largest score. For stochastic policies, the scores are logits.
    """
    import torch
    from torch.export import Dim

    from flowrep.agent.networks import PolicyNetwork

    networks = [module for module in policy.modules() if isinstance(module, PolicyNetwork)]
    if len(networks) != 1:
        raise ExportError(
            f"a policy is exported through its one flowrep.agent.networks.PolicyNetwork, of which "
            f"{type(policy).__name__} has {len(networks)}; build it with acting_network()"
        )
    (network,) = networks
    specs = [observation_spec[codec.key] for codec in network.codecs]
    maps = tuple(torch.zeros(2, *spec.shape[-3:], dtype=spec.dtype) for spec in specs)
    any_number = ({0: Dim("batch")},) * len(maps)
    with torch.no_grad():
        own = copy.deepcopy(network).cpu().eval()
        return torch.export.export(own, maps, dynamic_shapes=(any_number,))


def write_agent(folder: Path, program: ExportedProgram, card: Mapping[str, Any]) -> None:
    """Writes the program, its weights, the loader that needs only torch, and last the card."""
    import torch
    from safetensors.torch import save

    from flowrep import load_agent
    from flowrep.experiment.agents import CARD, LOADER, PROGRAM

    traced = io.BytesIO()
    torch.export.save(program, traced)
    weights = {name: weight.detach().contiguous() for name, weight in program.state_dict.items()}
    files = {PROGRAM: traced.getvalue(), "agent.safetensors": save(weights)}
    # a damaged file is noticed by it: torch.export.load takes what it finds
    digests = {name: zlib.crc32(data) for name, data in files.items()}
    digests[CARD] = zlib.crc32(json.dumps(dict(card)).encode())
    files[LOADER] = Path(load_agent.__file__).read_bytes()  # without one, as it may be edited
    files[CARD] = (json.dumps({**card, "crc32": digests}, indent=2) + "\n").encode()
    folder.mkdir(parents=True, exist_ok=True)
    replace_files(folder, files, as_one=True)


def main() -> None:
    """Entry point."""
    run_command("export", run, ExportConfig)


if __name__ == "__main__":
    main()
