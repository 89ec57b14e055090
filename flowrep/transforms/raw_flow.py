"""Exact optical flow of a simulated world."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from flowrep import geometry
from flowrep.transforms.base import DEPTH, IDS, MOTIONS, Keys
from flowrep.transforms.flow import FlowTransform, Intrinsics, checked_outputs

_KEYS: list[NestedKey] = [
    ("sensor", "depth"),
    ("sensor", "instance"),
    ("sensor", "instance_motion"),
]


class RawFlow(FlowTransform):
    """Exact optical flow of a world of rigid bodies, from a simulator's state.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"raw"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "instance")` | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |
    | `("sensor", "instance_motion")` | `"raw_valid"` | as `"valid"` | | |

    Convention: p_t − p_t' on the current frame's grid, channels (u right, v down), t' the previous
    step (Eq. 1 of the paper). Row i of `instance_motion` `[*B, N, 4, 4]` maps a point fixed to
    instance i from the current camera's frame to its place in the previous camera's frame; row 0 is
    the static world's. The observation thus holds everything that flow needs of the previous step.
    Where flow isn't known, because depth is `nan` or a point was not in front of the previous
    camera, raw is 0 and the mask beside it, `"raw_valid"`, is False: `FlowFactorize` reads both.
    No state is kept, and shuffled samples of a replay buffer give the same flow as the env.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels; or the env's key for
            it, `[*B, 3, 3]`.
        outputs: which of `"raw"` and `"valid"` to write.
        scale: factor on the flow.
        unit: `"px_per_step"` or `"px_per_s"`.
        dt_s: duration of a step in seconds; needed only for `"px_per_s"`.
        compiled: whether `compute` runs through `torch.compile`, which is some five times as fast
            on a CPU and equal up to rounding. Compiling takes up to a minute; later processes find
            the result in torch's cache. Otherwise numba, where it is installed, computes large
            float32 batches on a CPU two to five times as fast as PyTorch, with the same bits.
        invalid: value, before scaling, where flow isn't known.
        in_keys: depth, instance ids and one motion per instance.
        out_keys: one key per output; their names by default. The mask's key follows raw's:
            `("sensor", "flow_valid")` for `("sensor", "flow")`.

    Raises:
        ValueError: for a K that can't be one, an unknown output or unit, or `"px_per_s"` without
            `dt_s`.

    Example:
        A body a metre away was 0.1 m further left: fx · 0.1 m / 1 m = 5 px to the right.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> motions = torch.eye(4).repeat(2, 1, 1)
        >>> motions[1, 0, 3] = -0.1
        >>> sensor = {
        ...     "depth": torch.ones(1, 1, 2),
        ...     "instance": torch.tensor([[[0, 1]]]),
        ...     "instance_motion": motions,
        ... }
        >>> raw = RawFlow([[50.0, 0, 1], [0, 50.0, 0.5], [0, 0, 1]])
        >>> raw(TensorDict({"sensor": sensor}))["raw"][0, 0, 1]
        tensor(5.)
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        outputs: Sequence[str] = ("raw",),
        scale: float = 1.0,
        unit: str = "px_per_step",
        dt_s: float | None = None,
        compiled: bool = False,
        invalid: float = 0.0,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        outputs = checked_outputs(outputs, ("raw", "valid"))
        super().__init__(
            intrinsics,
            [DEPTH, IDS, MOTIONS],
            outputs=outputs,
            scale=scale,
            unit=unit,
            dt_s=dt_s,
            compiled=compiled,
            in_keys=_KEYS if in_keys is None else in_keys,
            out_keys=out_keys,
            masked=["raw"],
        )
        self.invalid = float(invalid)

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from depth, instance ids and motions (and K)."""
        (depth, instance, motions), K = self._with_camera(maps)
        motions, depth, K = self._at_one_precision(motions, depth=depth, K=K)
        flow, valid = geometry.rigid_flow(depth, instance, K, motions)
        if self.invalid != 0.0:
            # Viewed as bytes, as inductor's CPU code fails to compile a `where` on a bool view.
            flow = torch.where(valid.view(torch.uint8) != 0, flow, self.invalid)
        made = [valid if name == "valid" else self._in_unit(name, flow) for name in self.outputs]
        return (*made, *[valid] * len(self.masks))
