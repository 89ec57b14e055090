"""Optical flow estimated from two pictures, for envs without exact flow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from flowrep.transforms.base import Keys, Reads
from flowrep.transforms.dis import DIS
from flowrep.transforms.flow import FlowTransform, checked_outputs, mask_spec
from flowrep.transforms.raft import NETWORKS, RAFT, SMALLEST_SIDE_PX

PICTURE_PAIR = Reads((6, "H", "W"), "integer")

# Takes two uint8 [N, 3, H, W], returns the flow from the first to the second, float [N, 2, H, W].
Estimator = Callable[[Tensor, Tensor], Tensor]


class EstimatedFlow(FlowTransform):
    """Optical flow estimated between the last two pictures.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"rgb2"`, uint8 `[*B, 6, H, W]` | `"raw"` | float32 `[*B, 2, H, W]` | any | `unit` × `scale` |
    | | `"unscaled"` if chosen | as above | any | px/step |
    | | `"raw_valid"`, `"unscaled_valid"` | bool `[*B, 1, H, W]` | | |

    Convention: p_t − p_t' on the current frame's grid, channels (u right, v down), t' the previous
    step, as in `RawFlow`. The estimator therefore runs from the current picture to the previous one
    and its flow is negated; from the previous to the current one it would lie on the wrong grid.

    The input is the previous picture and, after it on the channels, the current one.
    `FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=["rgb2"])` writes them, correctly across
    resets and in a replay buffer. After a reset the current picture comes twice and flow is
    exactly 0. This transform itself keeps no state.

    Where the estimator's flow isn't finite, flow is 0 and the mask beside it False, as `RawFlow`'s.

    Args:
        estimator: `"dis"`, `"raft_small"` or `"raft_large"` (which need `weights`), or a function
            from two batches of pictures, uint8 `[N, 3, H, W]`, to the flow from the first to the
            second, float `[N, 2, H, W]`, e.g. a configured `flowrep.transforms.DIS`. A function has
            none of the following three options.
        weights: file with RAFT's weights, see `flowrep.transforms.RAFT`.
        preset: of DIS, see `flowrep.transforms.DIS`; RAFT doesn't read it.
        min_side_px: smaller pictures are enlarged to this; for RAFT to at least 128.
        outputs: which of `"raw"` and `"unscaled"` to write.
        scale: factor on raw.
        unit: of raw, `"px_per_step"` or `"px_per_s"`.
        dt_s: duration of a step in seconds; needed only for `"px_per_s"`.
        in_keys: the pair of pictures.
        out_keys: one key per output; their names by default.

    Raises:
        ValueError: for an unknown estimator, output or unit, `weights` for another estimator than
            RAFT, options for a function, and in each call for flow of another shape.
        ImportError: if a library that the estimator needs is not installed.

    Example:
        A texture that moved 2 px to the right since the previous picture.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> noise = torch.rand(1, 3, 8, 12, generator=torch.Generator().manual_seed(0))
        >>> texture = torch.nn.functional.interpolate(255 * noise, scale_factor=8.0)
        >>> now = texture[0].to(torch.uint8)
        >>> pair = torch.cat([now.roll(-2, -1), now])  # the previous picture, then the current one
        >>> u, v = EstimatedFlow()(TensorDict({"rgb2": pair}))["raw"]
        >>> u.median().round()
        tensor(2.)
    """

    def __init__(
        self,
        estimator: str | Estimator = "dis",
        *,
        weights: str | Path | None = None,
        preset: str = DIS.preset,
        min_side_px: int = DIS.min_side_px,
        outputs: Sequence[str] = ("raw",),
        scale: float = 1.0,
        unit: str = "px_per_step",
        dt_s: float | None = None,
        in_keys: Keys = "rgb2",
        out_keys: Keys | None = None,
    ) -> None:
        outputs = checked_outputs(outputs, ("raw", "unscaled"))
        factors: dict[str, Any] = {"raw": scale, "unscaled": 1.0}
        units = {"raw": unit, "unscaled": "px_per_step"}
        super().__init__(
            None,
            [PICTURE_PAIR],
            outputs=outputs,
            scale={name: factors[name] for name in outputs},
            unit={name: units[name] for name in outputs},
            dt_s=dt_s,
            compiled=False,
            in_keys=in_keys,
            out_keys=out_keys,
            masked=["raw", "unscaled"],
        )
        self.estimator = _estimator(estimator, weights, preset, min_side_px)

    def compute(self, pair: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs."""
        batch, size = pair.shape[:-3], pair.shape[-2:]
        previous, current = pair.to(torch.uint8).reshape(-1, 6, *size).chunk(2, -3)
        flow = self.estimator(current, previous)
        if flow.shape != (len(current), 2, *size):
            raise ValueError(
                f"representation {self.label}: the estimator should return [N, 2, H, W], "
                f"{[len(current), 2, *size]}, got {list(flow.shape)}; channels that come last, as "
                "OpenCV's, are moved by flow.movedim(-1, 1)"
            )
        flow = -flow.to(torch.float32)
        # After a reset both pictures are the same, and nothing has moved.
        differs = (current != previous).flatten(1).any(1).reshape(-1, 1, 1, 1)
        flow = torch.where(differs, flow, 0.0).reshape(*batch, 2, *size)
        known = flow.isfinite().all(-3, keepdim=True)
        flow = torch.where(known, flow, 0.0)
        made = [self._in_unit(name, flow) for name in self.outputs]
        return (*made, *[known] * len(self.masks))

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec per flow and a boolean one per mask."""
        (pair,) = specs
        batch, size = pair.shape[:-3], pair.shape[-2:]
        flows = [Unbounded((*batch, 2, *size), device=pair.device) for _ in self.outputs]
        return (*flows, *(mask_spec(batch, size, pair.device) for _ in self.masks))


def _estimator(
    estimator: str | Estimator, weights: str | Path | None, preset: str, min_side_px: int
) -> Estimator:
    if estimator in NETWORKS:
        if weights is None:
            raise ValueError(f"estimator {estimator!r} needs weights=, a file with its state dict")
        return RAFT(weights, estimator, min_side_px=max(min_side_px, SMALLEST_SIDE_PX))
    if weights is not None:
        raise ValueError(f"weights= are RAFT's; estimator {estimator!r} has none")
    if estimator == "dis":
        return DIS(preset, min_side_px)
    if callable(estimator):
        if (preset, min_side_px) != (DIS.preset, DIS.min_side_px):
            raise ValueError(
                f"preset={preset!r} and min_side_px={min_side_px} are not read if the estimator is "
                "a function: set them in it, e.g. estimator=DIS(preset, min_side_px)"
            )
        return estimator
    raise ValueError(
        f"estimator must be one of {['dis', *NETWORKS]} or a function, got {estimator!r}"
    )
