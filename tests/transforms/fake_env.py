"""An env whose maps name the env, the episode and the step that they belong to.

Every map is a plain function of (env, episode, step), asymmetric in rows and columns, so that a
test can say what any frame must hold. Episodes of env e last 3 + e % 2 steps: in a batch they end
at different times.
"""

import math

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

HEIGHT, WIDTH = 5, 7
NUM_CLASSES = 4
NUM_INSTANCES = 3
# fx, fy, cx, cy all differ, and the principal point is off the centre (3.5, 2.5).
INTRINSICS = [[6.0, 0.0, 3.2], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]]

WALKER, STATUE = 1, 2  # instance ids: one moves by itself, one has the static world's motion


def frame(env: int, episode: int, step: int) -> dict[str, Tensor]:
    """Returns the sensor maps of one moment."""
    column = torch.arange(WIDTH).expand(HEIGHT, WIDTH)
    row = torch.arange(HEIGHT).unsqueeze(-1).expand(HEIGHT, WIDTH)
    depth = 2.0 + 0.5 * column + 0.25 * row + 0.01 * step + 1.0 * episode + 10.0 * env
    depth[0, 1] = math.inf
    depth[1, 2] = math.nan
    instance = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    instance[2:4, 1:4] = WALKER
    instance[0, 5] = STATUE
    world_from_cam, world_from_body = poses(env, episode, step)
    channel = torch.arange(3)[:, None, None]
    return {
        "depth": depth.unsqueeze(0),
        "semantic": ((column + 2 * row + step + env) % NUM_CLASSES).to(torch.uint8).unsqueeze(0),
        "instance": instance.unsqueeze(0),
        "prev_from_curr": camera_motion(step, env),
        "instance_motion": frame_motions(step, env),
        "world_from_cam": world_from_cam,
        "world_from_body": world_from_body,
        "K": torch.tensor(INTRINSICS),
        "rgb": ((50 * channel + column + 7 * row + step) % 256).to(torch.uint8),
    }


def poses(env: int, episode: int, step: int) -> tuple[Tensor, Tensor]:
    """Returns where the camera `[4, 4]` and the bodies `[2, 4, 4]` are: float64, a wide world."""
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[:3, 3] = torch.tensor([5000.3 + 100 * env, -7.7, 10.1 * episode])
    statue, walker = torch.eye(4).double(), torch.eye(4).double()
    statue[:3, 3] = torch.tensor([5003.1, -6.0, 4.0])
    walker[:3, 3] = torch.tensor([4999.9, -5.0, 3.0])
    for past in range(1, step + 1):
        camera = frame_motions(past, env).double()
        world_from_prev, world_from_cam = world_from_cam, world_from_cam @ camera[0]
        # What takes a point from the current to the previous camera says where the body went.
        walker = world_from_cam @ camera[WALKER].inverse() @ world_from_prev.inverse() @ walker
    return world_from_cam, torch.stack([walker, statue])


def frame_motions(step: int, env: int) -> Tensor:
    """Returns `instance_motion` `[3, 4, 4]`: the walker moves by itself, the statue doesn't."""
    motions = camera_motion(step, env).repeat(NUM_INSTANCES, 1, 1)
    if step:
        motions[WALKER, 0, 3] += 0.3
        motions[WALKER, 1, 3] -= 0.1
    return motions


def camera_motion(step: int, env: int) -> Tensor:
    """Returns prev_from_curr: a turn to the right and a drive ahead; none at a reset."""
    angle = 0.03 * min(step, 1) * (1 + env % 3)
    motion = torch.eye(4)
    motion[0, 0] = motion[2, 2] = math.cos(angle)
    motion[0, 2], motion[2, 0] = math.sin(angle), -math.sin(angle)
    motion[:3, 3] = torch.tensor([0.05, 0.0, 0.4]) * min(step, 1)
    return motion


def moments(count: int) -> TensorDict:
    """Returns frames of different envs, episodes and steps, with a raw flow of their own."""
    frames = [TensorDict({"sensor": frame(i % 3, i % 2, i)}) for i in range(count)]
    td = TensorDict(torch.stack(frames), [count])
    td["raw"] = torch.randn(count, 2, HEIGHT, WIDTH, generator=torch.manual_seed(1))
    return td


def moment(depth: Tensor) -> tuple[int, int, int]:
    """Returns (env, episode, step) of a depth map of `frame`."""
    hundredths = round(100 * (depth[0, 0, 0].item() - 2.0))
    return hundredths // 1000, hundredths % 1000 // 100, hundredths % 100


class FakeSensorEnv(EnvBase):
    """Emits `frame`s, for a batch of envs or a single one."""

    batch_locked = True

    def __init__(self, batch_size: tuple[int, ...] = (), first_env: int = 0) -> None:
        super().__init__(batch_size=batch_size)
        count = math.prod(batch_size)
        self.env_ids = [first_env + i for i in range(count)]
        self.episodes = [-1] * count
        self.steps = [0] * count
        self.observation_spec = Composite(
            sensor=Composite(
                depth=Unbounded((*batch_size, 1, HEIGHT, WIDTH)),
                semantic=self._ids(NUM_CLASSES),
                instance=self._ids(NUM_INSTANCES),
                prev_from_curr=Unbounded((*batch_size, 4, 4)),
                instance_motion=Unbounded((*batch_size, NUM_INSTANCES, 4, 4)),
                world_from_cam=Unbounded((*batch_size, 4, 4), dtype=torch.float64),
                world_from_body=Unbounded((*batch_size, 2, 4, 4), dtype=torch.float64),
                K=Unbounded((*batch_size, 3, 3)),
                rgb=Bounded(0, 255, (*batch_size, 3, HEIGHT, WIDTH), dtype=torch.uint8),
                shape=batch_size,
            ),
            shape=batch_size,
        )
        self.action_spec = Categorical(3, shape=batch_size)
        self.reward_spec = Unbounded((*batch_size, 1))

    def _ids(self, n: int) -> Categorical:
        return Categorical(n, shape=(*self.batch_size, 1, HEIGHT, WIDTH), dtype=torch.uint8)

    def _observe(self) -> TensorDict:
        moments = zip(self.env_ids, self.episodes, self.steps)
        frames = torch.stack([TensorDict(frame(*moment)) for moment in moments])
        frames = frames.reshape(self.batch_size) if self.batch_size else frames[0]
        return TensorDict({"sensor": frames}, self.batch_size)

    def _flags(self, values: list[bool]) -> Tensor:
        return torch.tensor(values).reshape(*self.batch_size, 1)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        reset = [True] * len(self.env_ids) if mask is None else mask.flatten().tolist()
        for i, starts in enumerate(reset):
            if starts:
                self.episodes[i], self.steps[i] = self.episodes[i] + 1, 0
        return self._observe().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.steps = [step + 1 for step in self.steps]
        done = self._flags([t >= 3 + e % 2 for e, t in zip(self.env_ids, self.steps)])
        observed = self._observe()
        observed.update({"done": done, "terminated": done, "reward": torch.ones_like(done).float()})
        return observed

    def _set_seed(self, seed: int | None) -> None:
        """Everything is deterministic."""


class SelfResettingEnv(FakeSensorEnv):
    """Begins the next episode in the step that ends one, as Isaac Lab does (native auto-reset)."""

    def __init__(self, batch_size: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size)
        self._torchrl_native_autoreset = True

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        ended = super()._step(tensordict)
        first = self._reset(TensorDict({"_reset": ended["done"]}, self.batch_size))
        return ended.set("sensor", first["sensor"])
