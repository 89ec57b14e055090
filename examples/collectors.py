"""Collects frames for one agent in several processes or machines, by TorchRL's collectors.

    pip install '.[sim]'
    python examples/collectors.py process 1 2 4   # processes of this machine
    pip install ray
    python examples/collectors.py ray 1 2 4       # Ray's workers, of the cluster in RAY_ADDRESS

Each worker has a batch of streets and computes their flow, so it sends only the maps that the agent
reads. The program prints the frames per second for each number of workers.
"""

import sys
import time
from functools import partial
from statistics import median

import torch
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from flowrep.envs import make_env

NUM_ENVS, STEPS, BATCHES = 16, 16, 16


def streets(seed: int) -> TransformedEnv:
    """Returns one worker's streets; each worker needs another seed, for other episodes."""
    torch.set_num_threads(1)  # a core for each worker
    return make_env("straight_road", ["ego", "obj"], num_envs=NUM_ENVS, seed=seed)


def make_collector(backend: str, workers: int) -> Collector:
    """Returns a collector whose batches join the frames of all workers."""
    on_ray = {"remote_configs": {"num_cpus": 1, "num_gpus": 0}}
    return Collector(
        [partial(streets, seed) for seed in range(workers)],
        None,  # random actions; a policy would be sent to the workers
        backend=backend,
        num_collectors=workers,
        sync=True,
        frames_per_batch=workers * NUM_ENVS * STEPS,
        total_frames=workers * NUM_ENVS * STEPS * (1 + BATCHES),
        backend_options=on_ray if backend == "ray" else None,
    )


def frames_per_s(backend: str, workers: int) -> float:
    """Returns the median over several batches, after a first one during which the workers start."""
    collector, rates = make_collector(backend, workers), []
    batches = iter(collector)
    next(batches)
    begin = time.perf_counter()
    for batch in batches:
        end = time.perf_counter()
        rates.append(batch.numel() / (end - begin))
        begin = end
    collector.shutdown()
    return median(rates)


if __name__ == "__main__":  # workers import this file
    backend, *numbers = sys.argv[1:] or ["process", "1", "2"]
    for workers in map(int, numbers):
        print(f"{backend}, {workers} workers: {frames_per_s(backend, workers):.0f} frames/s")
