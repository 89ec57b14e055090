from functools import partial

import pytest
import torch
import yaml
from torchrl.data import Bounded, Categorical, Composite, Unbounded

import flowrep.agent
from flowrep.agent import DiscreteSAC
from flowrep.agent.map_codec import store_maps
from flowrep.config import CONF_DIR, group_choices

ALGORITHMS = group_choices("algorithm")
SMALL = {
    "precision": "fp32", "hidden_size": 32, "batch_size": 16, "replay_capacity": 100,
    "rollout_length": 8,
}  # fmt: skip
HEIGHT, WIDTH = 38, 45  # neither square nor a multiple of the first stride


@pytest.fixture
def observation_spec():
    """Three kinds of map, as a vector of five environments declares them."""
    shape = (5, 2, HEIGHT, WIDTH)
    return Composite(
        {
            "flow": Unbounded(shape, dtype=torch.float32),
            "seg": Categorical(4, (5, 1, HEIGHT, WIDTH), dtype=torch.uint8),
            "rgb": Bounded(0, 255, (5, 3, HEIGHT, WIDTH), dtype=torch.uint8),
        },
        shape=(5,),
    )


@pytest.fixture
def make_agent(observation_spec):
    """Builds a small float32 agent; keyword arguments replace its settings."""

    def make(
        algorithm=DiscreteSAC, *, spec=observation_spec, keys=("flow", "seg"), seed=0,
        action_spec=None, **changes,
    ):  # fmt: skip
        torch.manual_seed(seed)
        action_spec = Categorical(3) if action_spec is None else action_spec
        known = algorithm.OPTIONS.model_fields
        options = {name: value for name, value in (SMALL | changes).items() if name in known}
        run = {name: value for name, value in changes.items() if name not in known}
        run = {"total_frames": 1000} | run
        return algorithm(spec, action_spec, list(keys), algorithm.OPTIONS(**options), **run)

    return make


@pytest.fixture(params=ALGORITHMS)
def make_any(request, make_agent):
    """Builds a small float32 agent of each algorithm in turn, which is `make_any.args[0]`."""
    file = yaml.safe_load((CONF_DIR / "algorithm" / f"{request.param}.yaml").read_text())
    name = file["_target_"].removeprefix("flowrep.agent.")
    return partial(make_agent, getattr(flowrep.agent, name))


@pytest.fixture
def random_maps(observation_spec):
    """Draws maps of every kind; floats are numbers that float16 holds exactly."""

    def draw(*batch):
        spec = observation_spec[0].expand(batch) if batch else observation_spec[0]
        maps = spec.rand()
        maps["flow"] = maps["flow"].half().float()
        return maps

    return draw


@pytest.fixture
def random_steps(random_maps):
    """Draws `[N]` unconnected steps; about a third of them terminated."""

    def draw(size):
        steps = random_maps(size)
        steps["action"] = torch.randint(3, (size,))
        steps["is_init"] = torch.ones(size, 1, dtype=torch.bool)
        steps["action_log_prob"] = torch.full((size,), -1.0)
        steps["next"] = random_maps(size)
        steps["next", "reward"] = torch.randn(size, 1)
        steps["next", "terminated"] = torch.rand(size, 1) < 0.3
        steps["next", "done"] = steps["next", "terminated"].clone()
        return steps

    return draw


@pytest.fixture
def as_batch():
    """Turns steps into what `ReplayMemory.sample` returns of them."""

    def convert(agent, steps):
        following = store_maps(agent.codecs, steps["next"])
        following.update(steps["next"].select("reward", "terminated", "done"))
        batch = store_maps(agent.codecs, steps)
        batch["steps_to_next_obs"] = torch.ones(*steps.batch_size, 1)
        return batch.update({"action": steps["action"], "next": following})

    return convert
