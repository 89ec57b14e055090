"""The parts of gpu.py that run envs: their speed by number of workers, and a short training.

Without the simulator, `RecordedStreets` provides synthetic sensor maps at no cost, moved to the
device at each step like a simulator's. Transforms, memory and updates are then measured, but not
the envs.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from update import agent_for

from flowrep.transforms import representation_stack

RECORDED_NOTE = "Made-up sensor maps stand in for the streets: no simulator was run."
MAPS = ("ego", "obj")
PAPER_FRAMES, GOAL_MINUTES = 2_000_000, 20
WORKERS = (0, 1, 4, 8, 16)
NUM_ENVS, SIDE, INSTANCES = 32, 84, 16


class RecordedStreets(EnvBase):
    """Cycles through random sensor readings on the CPU; an episode ends after 100 steps on average.

    Args:
        num_envs: size of the batch.
        side: height and width of the maps.
        device: device of the returned readings.
        readings: number of readings.
    """

    def __init__(self, num_envs: int, side: int, device: torch.device, readings: int = 8) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        n, size = num_envs, (num_envs, 1, side, side)
        sensor = Composite(
            depth=Unbounded(size),
            instance=Bounded(0, INSTANCES - 1, size, dtype=torch.uint8),
            prev_from_curr=Unbounded((n, 4, 4)),
            instance_motion=Unbounded((n, INSTANCES, 4, 4)),
            shape=(n,),
        )
        self.observation_spec = Composite(sensor=sensor, shape=(n,)).to(device)
        self.action_spec = Categorical(3, shape=(n,), device=device)
        self.reward_spec = Unbounded((n, 1), device=device)
        self._readings = [self._made_up(n, size) for _ in range(readings)]
        self._next = 0

    @staticmethod
    def _made_up(n: int, size: tuple[int, ...]) -> TensorDict:
        motion = torch.eye(4).repeat(n, INSTANCES, 1, 1)
        motion[..., 2, 3] = 0.8 + 0.1 * torch.randn(n, INSTANCES)  # metres ahead in a frame
        maps = {
            "depth": 2 + 60 * torch.rand(size),
            "instance": torch.randint(INSTANCES, size, dtype=torch.uint8),
            "prev_from_curr": motion[:, 0].clone(),
            "instance_motion": motion,
        }
        return TensorDict({"sensor": TensorDict(maps, [n])}, [n])

    def _read(self) -> TensorDictBase:
        self._next = (self._next + 1) % len(self._readings)
        return self._readings[self._next].to(self.device)

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDictBase:
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*self.batch_size, 1)
        ended = (torch.rand(shape) < 0.01).to(self.device)
        reward = torch.full(shape, 0.01, device=self.device)
        return self._read().update({"reward": reward, "terminated": ended, "done": ended.clone()})

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            torch.manual_seed(seed)


def recorded_env(num_envs: int, side: int, device: torch.device) -> TransformedEnv:
    """Returns envs with synthetic sensor maps, ego and obj."""
    K = torch.tensor([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1.0]])
    stack = representation_stack(MAPS, intrinsics=K, num_classes=5, dt_s=1 / 12)
    env = TransformedEnv(RecordedStreets(num_envs, side, device), stack)
    return env.append_transform(InitTracker())


def street_env(num_envs: int, side: int, num_workers: int, device: torch.device) -> EnvBase:
    """Returns simulated envs with ego and obj; the only call of `make_env` here."""
    import dataclasses

    from flowrep.envs import make_env
    from flowrep.scenes import load_scene

    scene = load_scene("straight_road")
    camera = dataclasses.replace(scene.camera, height_px=side, width_px=side)
    scene = dataclasses.replace(scene, camera=camera)
    return make_env(scene, MAPS, num_envs=num_envs, num_workers=num_workers, device=device, seed=0)


def finish(device: torch.device) -> float:
    """Returns the time after the device has finished all its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def street_rates(device: torch.device, *, recorded: bool, quick: bool) -> list[dict[str, Any]]:
    """Returns frames a second, a row for each number of workers; 0 is this process alone."""
    num_envs, side, steps = (2, 40, 3) if quick else (NUM_ENVS, SIDE, 60)
    workers = (0, 1) if quick else WORKERS
    rows = []
    for count in (0,) if recorded else workers:
        env = (
            recorded_env(num_envs, side, device)
            if recorded
            else street_env(num_envs, side, count, device)
        )
        observation, start = env.reset(), 0.0
        for step in range(2 * steps):
            if step == steps:  # the first half warms up
                start = finish(device)
            _, observation = env.step_and_maybe_reset(env.rand_action(observation))
        rate = num_envs * steps / (finish(device) - start)
        env.close()
        rows.append({"workers": count, "num_envs": num_envs, "frames/s": rate})
    return rows


def training(
    device: torch.device, *, recorded: bool, quick: bool
) -> tuple[dict[str, Any], list[str]]:
    """Returns a row with the rate of a short training's second half and the projected time."""
    measure = recorded_training if recorded else simulated_training
    (frames, seconds), notes = measure(device, quick)
    minutes = PAPER_FRAMES / frames * seconds / 60
    row = {
        "frames": frames,
        "s": seconds,
        "frames/s": frames / seconds,
        f"min for {PAPER_FRAMES:,}": minutes,
        "goal, min": GOAL_MINUTES,
        "reached": "yes" if minutes < GOAL_MINUTES else "no",
    }
    return row, [RECORDED_NOTE, *notes] if recorded else notes


def simulated_training(device: torch.device, quick: bool) -> tuple[tuple[int, float], list[str]]:
    """Trains as `python -m flowrep.train` does, without evaluations."""
    from hydra import compose, initialize_config_dir

    from flowrep.config import CONF_DIR
    from flowrep.config.cli import plain_config, register_resolvers
    from flowrep.config.schema import TrainConfig, validated
    from flowrep.experiment.run import RunFolder
    from flowrep.experiment.runner import Runner
    from flowrep.progress import StopRequest

    register_resolvers()
    size = ["debug=smoke"] if quick else ["preset=paper", "total_frames=20_000"]
    # the evaluation hook reads the clock in the middle and at the end
    total = 256 if quick else 20_000
    cadence = [f"evaluation.every_frames={total // 2}", "checkpoint_every_frames=1_000_000_000"]
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        composed = compose("train", [*size, *cadence, f"device={device}"])
    config = validated(TrainConfig, plain_config(composed))
    marks: list[tuple[int, float]] = []

    class Marked(Runner):
        def evaluate(self, kind: str, stop: StopRequest) -> bool:
            marks.append((self.frames, finish(device)))
            return True

    with tempfile.TemporaryDirectory() as folder:
        runner = Marked(config, RunFolder(Path(folder)))
        try:
            runner.train(StopRequest())
        finally:
            runner.close()
        clock = runner.clock
    (frames, start), (last, end) = marks[0], marks[-1]
    shares = "of the host's time; kernels that nobody waited for count where somebody did"
    return (last - frames, end - start), [f"{clock.summary()} ({shares})."]


def recorded_training(device: torch.device, quick: bool) -> tuple[tuple[int, float], list[str]]:
    """Acts, stores and learns as training does, without logging."""
    num_envs, side, total, batch = (4, 40, 256, 16) if quick else (NUM_ENVS, SIDE, 20_000, 1024)
    env = recorded_env(num_envs, side, device)
    agent = agent_for(env.observation_spec, env.action_spec, MAPS, device=device, batch_size=batch)
    observation, frames, marks = env.reset(), 0, []
    while frames < total:
        with torch.no_grad():
            acted = agent.policy(observation)
        for _ in range(agent.updates_due(frames)):
            agent.update(agent.sample())
        stepped, observation = env.step_and_maybe_reset(acted)
        agent.remember(stepped)
        frames += num_envs
        if frames >= total // 2 * (1 + len(marks)):
            marks.append((frames, finish(device)))
    (first, start), (last, end) = marks
    return (last - first, end - start), []
