"""Conversion of flow from estimators and data sets to p_t - p_t' on the current frame's grid."""

from __future__ import annotations

from typing import Literal, TypeAlias

from torch import Tensor

from flowrep.geometry.checks import check_name, check_shape

Direction: TypeAlias = Literal["forward", "backward"]
Grid: TypeAlias = Literal["current", "previous"]
Channels: TypeAlias = Literal["uv", "row_column"]


def adapt_flow(
    flow: Tensor, *, direction: Direction, grid: Grid, channels: Channels = "uv"
) -> Tensor:
    """Returns flow p_t - p_t' on the current frame's grid, (u right, v down), `[*B, 2, H, W]`.

    Convention: `direction` is that of the vectors: `"forward"` is p_t - p_t', from a point's
    previous to its current position; `"backward"` is p_t' - p_t. `grid` is the frame whose pixels
    they belong to. An estimator called with (current, previous) gives backward flow on the current
    grid.

    Flow on the previous frame's grid raises ValueError: its pixels have moved, several of them to
    the same pixel and none to others, so flow on the current grid would be a guess.

    Args:
        flow: `[*B, 2, H, W]`, pixels.
        direction: `"forward"` or `"backward"`.
        grid: `"current"` or `"previous"`.
        channels: `"uv"` (column first) or `"row_column"`.

    Raises:
        ValueError: an unknown name, a shape that does not fit, or flow on the previous grid.
        TypeError: no float tensor.

    >>> import torch
    >>> flow = torch.tensor([3.0, -2.0]).reshape(2, 1, 1)  # 3 rows up, 2 columns right it was
    >>> adapt_flow(flow, direction="backward", grid="current", channels="row_column").flatten()
    tensor([ 2., -3.])
    """
    check_flow_options(direction, grid, channels)
    check_shape("flow", flow, (2, "H", "W"))
    if channels == "row_column":
        flow = flow.flip(-3)
    return -flow if direction == "backward" else flow


def check_flow_options(direction: str, grid: str, channels: str) -> None:
    """Raises ValueError for an unknown name, and for the previous frame's grid."""
    check_name("direction", direction, Direction)
    check_name("grid", grid, Grid)
    check_name("channels", channels, Channels)
    if grid == "previous":
        raise ValueError(
            f"{direction} flow on the previous frame's grid cannot be turned into flow on the "
            "current frame's grid exactly: pixels that were covered have no vector, and where "
            "several land on one only depth says which is seen. Have the flow computed from the "
            "current frame to the previous one (most estimators: swap the two pictures) and adapt "
            "it with direction='backward', grid='current'"
        )
