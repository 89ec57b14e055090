"""Networks and discrete SAC: sees specs and keys, never an environment or a representation."""

from flowrep.agent.allocator import keep_freed_memory
from flowrep.agent.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from flowrep.agent.dsac import DiscreteSAC
from flowrep.agent.replay import ReplayMemory

__all__ = [
    "CheckpointError",
    "DiscreteSAC",
    "ReplayMemory",
    "keep_freed_memory",
    "load_checkpoint",
    "save_checkpoint",
]
