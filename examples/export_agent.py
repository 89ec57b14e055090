"""Exports a trained agent as one file, and loads it where only torch is installed.

    python examples/export_agent.py outputs/<day>/<run> agent.pt2

docs/other_agents.md says how `flowrep.evaluate` drives it. PyTorch's loader unpickles parts of the
file, which can run code, so load only files that you trust.
"""

import sys
from contextlib import closing

import torch
from torch.export import Dim


def export(run, path):
    """Writes the network of an agent, a map `[N, C, H, W]` an argument, and the maps' names."""
    from flowrep import Agent
    from flowrep.agent.networks import PolicyNetwork

    agent = Agent.load(run, precision="fp32", device="cpu")
    (network,) = (each for each in agent.policy.modules() if isinstance(each, PolicyNetwork))
    names = [codec.key for codec in network.codecs]
    with closing(agent.make_env(num_envs=2, num_workers=0)) as env:
        maps = tuple(env.reset()[name] for name in names)
    any_number = tuple({0: Dim("batch")} for _ in names)
    with torch.no_grad():
        program = torch.export.export(network.eval(), maps, dynamic_shapes=(any_number,))
    torch.export.save(program, path, extra_files={"maps": ",".join(names)})
    return names


def load(path):
    """Returns a function from maps by name to the greedy actions `[N]`."""
    files = {"maps": ""}
    program = torch.export.load(path, extra_files=files).module()
    names = files["maps"].split(",")
    # The program returns a score per action: logits, or the values of a DQN.
    return lambda maps: program(*(maps[name] for name in names)).argmax(-1)


if __name__ == "__main__":
    print(f"{sys.argv[2]}: representations=[{','.join(export(*sys.argv[1:]))}]")
