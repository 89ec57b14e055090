"""Every transition whose successor was stored is sampled, in every representation."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import InitTracker

from flowrep.agent.observation import map_codecs
from flowrep.agent.replay import ReplayMemory
from flowrep.envs import make_env

STREETS, STEPS = 2, 12
STACKS = {
    "flows": {"raw": {"scale": 0.125}, "ego": {"scale": 0.125}, "obj": {"scale": 8.0}},
    "mirrored": {"ego": {"scale": -1.0}, "obj": {"scale": -1.0}},
    "stacks": {"seg2": {"k": 2}, "depth2": {"k": 2}},
    "single": {"seg": {}, "depth": {}},
}


@pytest.mark.slow_after_first
@pytest.mark.parametrize("stack", STACKS)
def test_every_transition_with_a_successor_is_sampled(straight_road, stack):
    small = replace(straight_road, camera=replace(straight_road.camera, height_px=36, width_px=36))
    env = make_env(scene=small, representations=STACKS[stack], num_envs=STREETS, seed=3)
    env = env.append_transform(InitTracker())
    keys = list(STACKS[stack])
    codecs = map_codecs(env.observation_spec, keys, torch.float32)
    replay = ReplayMemory(codecs, capacity=200, batch_size=2000, device="cpu")
    observation = env.reset()
    torch.manual_seed(0)
    expected = 0
    for number in range(STEPS):
        observation["action"] = torch.randint(3, (STREETS,))
        stepped, observation = env.step_and_maybe_reset(observation)
        # what tells transitions apart in the sample
        stepped["next", "reward"] = number * STREETS + torch.arange(STREETS).float()[:, None]
        replay.extend(stepped)
        is_last = number == STEPS - 1
        expected += STREETS if not is_last else int(stepped["next", "terminated"].sum())
    env.close()
    assert len(replay.sample()["next", "reward"].unique()) == expected
