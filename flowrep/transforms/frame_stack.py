"""The last k frames of a map, exact across resets, in batched envs and in a replay buffer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from flowrep.transforms.base import Keys, Reads, RecurrentTransform, refuse_n_step


class FrameStack(RecurrentTransform):
    """The last `k` frames on the channel dimension, oldest first.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | a map `[*B, C, H, W]` | its stack | same type, `[*B, k·C, H, W]` | the map's | the map's |

    After a reset all k frames are the episode's first. The previous step's stack is read from the
    TensorDict passed to `step`, where the env declares it as part of its state, as TorchRL's
    `StepCounter` does. No state is kept between calls, so stacks can't mix episodes or envs.
    TorchRL's `CatFrames` keeps state: in a replay buffer it stacks neighbours in a sample, which is
    wrong if samples are shuffled.

    In a replay buffer the stored root stack and the next frame give the next stack exactly,
    shuffled or not. If `("next", out_key)` is not stored, a transition takes k + 1 frames instead
    of 2 k. A stack stored under `"next"` is left unchanged; n-step returns need it stored, since
    their next frame is several steps ahead.

    A batch without a stored stack has to be a trajectory, with a dimension named "time" and
    `("next", "done")`; its first frame counts as an episode's first. A buffer may thus store single
    frames (two per transition, or one if `next` is looked up) and sample slices of an episode.
    Stacks are exact from the k-th step of a slice on, `batch[:, k - 1:]`.

    Args:
        k: number of frames, at least 1.
        in_keys: maps to stack.
        out_keys: keys of the stacks; must differ from the maps' keys.

    Raises:
        ValueError: for k < 1 or an output key that is also an input key.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> frames = torch.arange(3.0).reshape(3, 1, 1, 1)
        >>> done = torch.tensor([[False], [True], [False]])  # the third frame begins an episode
        >>> td = TensorDict({"depth": frames, "next": {"depth": frames + 1, "done": done}}, [3])
        >>> td.names = ["time"]
        >>> FrameStack(k=2, in_keys=["depth"], out_keys=["depth2"])(td)["depth2"].flatten(1)
        tensor([[0., 0.],
                [0., 1.],
                [2., 2.]])
    """

    def __init__(self, *, k: int = 2, in_keys: Keys, out_keys: Keys) -> None:
        maps = len(in_keys) if isinstance(in_keys, list) else 1
        reads = [Reads((f"C{i}", f"H{i}", f"W{i}")) for i in range(maps)]
        super().__init__(reads, in_keys, out_keys)
        if k < 1:
            raise ValueError(f"k, the number of frames, must be at least 1; got {k}")
        if len(self.out_keys) != len(self.in_keys) or set(self.in_keys) & set(self.out_keys):
            raise ValueError(
                f"FrameStack needs an output key of its own for each input key; "
                f"got {self.in_keys} -> {self.out_keys}"
            )
        self.k = int(k)

    def compute(self, *frames: Tensor) -> tuple[Tensor, ...]:
        """Returns the stacks at an episode's first frame, which is repeated k times."""
        return tuple(torch.cat([frame] * self.k, -3) for frame in frames)

    @property
    def carried_keys(self) -> list[NestedKey]:
        """The stacks of the step before."""
        return self.out_keys

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Returns the stacks of the step before with the current frames appended."""
        return tuple(push_frame(stack, frame) for stack, frame in zip(before, now))

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the stacks of a replay batch, at its root and under `"next"`."""
        following = tensordict.get("next", None)
        for frame_key, stack_key in zip(self.in_keys, self.out_keys):
            stack = tensordict.get(stack_key, None)
            if stack is None:
                stack = self._stack_from_trajectory(tensordict, frame_key, stack_key)
                tensordict.set(stack_key, stack)
            if following is None or following.get(stack_key, None) is not None:
                continue  # stored: correct even if the next frame is several steps ahead
            frame = following.get(frame_key, None)
            if frame is not None:
                refuse_n_step(tensordict, stack_key)
                tensordict.set(_under_next(stack_key), push_frame(stack, frame))
        return tensordict

    def _stack_from_trajectory(
        self, tensordict: TensorDictBase, frame_key: NestedKey, stack_key: NestedKey
    ) -> Tensor:
        frames = tensordict.get(frame_key, None)
        if frames is None:
            raise self._missing(frame_key, tensordict)
        done, time_dim = self._trajectory(tensordict, stack_key)
        return stack_trajectory(frames, done, self.k, time_dim)

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns each map's spec with k times the channels."""
        return tuple(_stacked(spec, self.k) for spec in specs)


def push_frame(stack: Tensor, frame: Tensor) -> Tensor:
    """Returns the stack `[*B, k·C, H, W]` with `frame` appended and the oldest frame dropped."""
    return torch.cat([stack[..., frame.shape[-3] :, :, :], frame], -3)


def stack_trajectory(frames: Tensor, done: Tensor, k: int, time_dim: int) -> Tensor:
    """Returns the stack at every step of a trajectory, equal to the env's.

    Args:
        frames: `[*B, C, H, W]`, with time at `time_dim` of the batch.
        done: `[*B]`, whether the episode ended with the step after the frame.
        k: number of frames.
        time_dim: position of time in the batch.
    """
    frames, done = frames.movedim(time_dim, 0), done.movedim(time_dim, 0)
    step = torch.arange(len(frames), device=frames.device)
    step = expand_as_right(step, done)  # [T, *B]
    begins = torch.cat([torch.ones_like(done[:1]), done[:-1]])
    first = torch.where(begins, step, 0).cummax(0).values  # where each step's episode begins
    ages = range(k - 1, -1, -1)  # oldest first
    picked = [torch.maximum(step - age, first) for age in ages]
    stack = torch.cat([frames.gather(0, expand_as_right(i, frames)) for i in picked], -3)
    return stack.movedim(0, time_dim)


def _under_next(key: NestedKey) -> tuple[str, ...]:
    return ("next", key) if isinstance(key, str) else ("next", *key)


def _stacked(spec: TensorSpec, k: int) -> TensorSpec:
    *batch, channels, height, width = spec.shape
    shape = torch.Size([*batch, k * channels, height, width])
    if isinstance(spec, Categorical):
        return Categorical(spec.n, shape=shape, device=spec.device, dtype=spec.dtype)
    if isinstance(spec, Bounded):
        low, high = (torch.cat([side] * k, -3) for side in (spec.space.low, spec.space.high))
        return Bounded(low, high, shape=shape, device=spec.device, dtype=spec.dtype)
    if isinstance(spec, Unbounded):
        return Unbounded(shape, device=spec.device, dtype=spec.dtype)
    raise TypeError(
        f"FrameStack stacks maps with a Categorical, Bounded or Unbounded spec, got {spec}"
    )
