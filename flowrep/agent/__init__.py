"""Networks and algorithms, built from specs and keys alone; they never see an env."""

from flowrep.extras import require

require("flowrep.agent", "train", "safetensors", "pydantic")

from flowrep.agent.algorithm import Algorithm, OffPolicy
from flowrep.agent.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from flowrep.agent.cpu import keep_freed_memory, torch_threads
from flowrep.agent.divergence import DivergenceError
from flowrep.agent.dqn import DoubleDQN
from flowrep.agent.dsac import DiscreteSAC
from flowrep.agent.dsac_v import DiscreteSACWithValue
from flowrep.agent.ppo import PPO
from flowrep.agent.replay import ReplayMemory

__all__ = [
    "PPO", "Algorithm", "CheckpointError", "DiscreteSAC", "DiscreteSACWithValue", "DivergenceError",
    "DoubleDQN", "OffPolicy", "ReplayMemory", "keep_freed_memory", "load_checkpoint",
    "save_checkpoint", "torch_threads",
]  # fmt: skip
