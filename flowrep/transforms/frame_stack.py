"""The last k frames of a map, exact across resets, in batched envs and in a replay buffer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from flowrep.geometry.checks import checked_count
from flowrep.transforms.base import (
    Keys,
    Reads,
    RecurrentTransform,
    check_distinct_keys,
    check_unconverted,
)


class FrameStack(RecurrentTransform):
    """The last `k` frames on the channel dimension, oldest first.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | a map `[*B, C, H, W]` | its stack | same type, `[*B, k·C, H, W]` | the map's | the map's |

    After a reset all k frames are the episode's first. The previous step's stack is read from the
    TensorDict passed to `step`, where the env declares it as part of its state, as TorchRL's
    `StepCounter` does. No state is kept between calls, so stacks can't mix episodes or envs.
    (TorchRL's `CatFrames` keeps state. In a replay buffer it stacks neighbours of a sample, which
    is wrong for shuffled samples.) What converts a stack afterwards, such as TorchRL's
    `ObservationNorm`, has to write to another key, since the next step reads the stack again. A
    `SelectTransform` around a batch of envs has to name the stack, or rollouts keep its first one.

    In a replay buffer, the stack stored at the root and the next frame give the next stack exactly,
    in shuffled samples too. Without `("next", out_key)`, a transition takes k + 1 frames instead of
    2 k. Store it for n-step returns, whose next frame is several steps ahead.

    A batch without a stored stack has to be a trajectory, with a dimension named "time" and
    `("next", "done")`. Its first frame counts as an episode's first. A buffer may thus store single
    frames (two per transition, or one if `next` is looked up) and sample slices of an episode.
    Stacks are exact from the k-th step of a slice on, `batch[:, k - 1:]`. Shuffled or joined steps,
    whose dimension TorchRL still names "time", are refused if their next frames are there.

    Args:
        k: the number of frames.
        in_keys: the maps.
        out_keys: one key for each stack, other than the maps' keys.

    Raises:
        ValueError: `k` is less than 1, a stack has the key of a map, or a later transform of the
            same `TransformedEnv` changes or drops a stack.
        MissingKey: in calls, the previous step or the trajectory is missing.

    Example:
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
        super().__init__(reads, in_keys, out_keys, writes=maps)
        check_distinct_keys(self)
        self.k = checked_count("k", k)

    @property
    def carried_keys(self) -> list[NestedKey]:
        """The previous step's stacks."""
        return self.out_keys

    def compute(self, *frames: Tensor) -> tuple[Tensor, ...]:
        """Returns the stacks at an episode's first frame, which is repeated k times."""
        return tuple(torch.cat([frame] * self.k, -3) for frame in frames)

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Returns the previous stacks without their oldest frames, followed by the new frames."""
        for key, stack, frame in zip(self.out_keys, before, now):
            check_unconverted(key, stack, frame)
        return tuple(
            torch.cat([stack[..., frame.shape[-3] :, :, :], frame], -3)
            for stack, frame in zip(before, now)
        )

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns each map's spec with k times the channels."""
        return tuple(_stacked(spec, self.k) for spec in specs)


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
    raise TypeError(f"FrameStack stacks Categorical, Bounded or Unbounded maps, got {spec}")
