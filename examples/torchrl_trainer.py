"""flowrep's env, replay memory and loss in TorchRL's Collector and Trainer.

    pip install '.[train]'
    python examples/torchrl_trainer.py --frames 100000

If you run it again with more frames, it continues where it stopped, bit for bit: `StreetCollector`
also saves the next observation and the state of the env, which TorchRL's collector does not.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker
from torchrl.objectives import SoftUpdate
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook, Trainer

from flowrep.agent import DiscreteSAC, ReplayMemory
from flowrep.agent.dsac import DiscreteSACMapLoss
from flowrep.agent.networks import action_count
from flowrep.config.algorithms import DiscreteSACOptions
from flowrep.envs import get_states, make_env, set_states
from flowrep.scenes import load_scene

MAPS = ["ego", "obj"]
GAMMA, N_STEPS = 0.97, 3


class StreetCollector(Collector):
    """A `Collector` of street envs that can resume in the middle of an episode."""

    def state_dict(self) -> dict[str, Any]:
        """Returns TorchRL's state, the next observation, the envs' states and torch's generator."""
        return super().state_dict() | {
            "carrier": self._carrier.to_dict(),
            "streets": get_states(self.env),
            "rng": torch.get_rng_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Restores a `state_dict`."""
        super().load_state_dict(state_dict, **kwargs)
        self._traj_pool.load_state_dict(state_dict["traj_pool"])  # TorchRL begins new trajectories
        set_states(self.env, state_dict["streets"])
        self._carrier = TensorDict(
            state_dict["carrier"], self.env.batch_size, device=self._carrier.device
        )
        torch.set_rng_state(state_dict["rng"])


def make_trainer(
    frames: int, num_envs: int, side: int, batch_size: int, capacity: int, seed: int
) -> Trainer:
    """Returns a trainer of discrete SAC with about one update for each 10 frames."""
    torch.manual_seed(seed)
    scene = load_scene("straight_road")
    scene = replace(scene, camera=replace(scene.camera, height_px=side, width_px=side))
    env = make_env(scene, MAPS, num_envs=num_envs, seed=seed).append_transform(InitTracker())
    spec, action_spec = env.observation_spec, env.action_spec
    options = DiscreteSACOptions(initial_alpha=0.05, gamma=GAMMA)
    policy = DiscreteSAC.make_policy(spec, action_spec, MAPS, options, total_frames=frames)
    network = policy[0].module.network
    loss = DiscreteSACMapLoss(network, action_count(action_spec), options)
    memory = ReplayMemory(
        network.codecs, capacity=capacity, batch_size=batch_size, device="cpu", n_steps=N_STEPS,
        gamma=GAMMA,
    )  # fmt: skip
    steps = 10  # frames of each env between two rounds of updates
    trainer = Trainer(
        collector=StreetCollector(
            env, policy, frames_per_batch=steps * num_envs, total_frames=frames
        ),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=num_envs,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        progress_bar=False,
    )
    ReplayBufferTrainer(memory).register(trainer)
    trainer.register_op("post_optim", TargetNetUpdaterHook(SoftUpdate(loss, tau=0.02)))
    return trainer


def train(
    file: Path, frames: int, num_envs: int = 32, side: int = 48, batch_size: int = 256,
    capacity: int = 50_000, seed: int = 0,
) -> Trainer:  # fmt: skip
    """Trains until `frames`, resuming from `file` if it exists, and writes `file`."""
    trainer = make_trainer(frames, num_envs, side, batch_size, capacity, seed)
    if file.exists():
        trainer.load_state_dict(torch.load(file, weights_only=True))

    def save() -> None:
        if trainer.collected_frames >= frames:  # the trainer closes its envs when it returns
            torch.save(trainer.state_dict(), file)

    trainer.register_op("post_steps", save)
    trainer.train()
    return trainer


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=99_840)
    parser.add_argument("--file", type=Path, default=Path("torchrl_trainer.pt"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    train(args.file, args.frames, seed=args.seed)
