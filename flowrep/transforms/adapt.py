"""Conversion of other simulators' and robots' sensor data to the inputs of flowrep's transforms.

Adapters never write to the key that they read, so that nothing is converted twice.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, Literal, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from flowrep import geometry
from flowrep.geometry.checks import checked_count
from flowrep.geometry.pose import POSE_SHAPES
from flowrep.transforms import base
from flowrep.transforms.base import Keys, MapTransform, Reads, check_distinct_keys
from flowrep.transforms.flow import CameraTransform, Intrinsics, masked_flow

MapLayout: TypeAlias = Literal["hw", "hwc"]

_OTHER_TYPE = 100_000  # more than the ids of bodies, so that InstanceIds names the others


class AdaptDepth(CameraTransform):
    """Converts any kind of depth to depth along the optical axis.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | depth of some `kind` | `("sensor", "depth")` | float `[*B, 1, H, W]` | > 0, inf, nan | m |
    | K, if `intrinsics` names a key | | | | |

    Convention and further arguments: see `flowrep.geometry.adapt_depth`.

    Args:
        intrinsics: K `[3, 3]` in pixels or its key; only for `"ray_length"` and `"disparity"`.
        channels_last: whether the env's depth is `[*B, H, W, 1]`.

    Raises:
        ValueError: an option that `kind` needs is missing, or one that it doesn't read is given.

    Example:
        >>> from tensordict import TensorDict
        >>> metres = AdaptDepth("z_buffer", near_m=0.5, far_m=8.0, in_keys="zbuffer")
        >>> metres(TensorDict(zbuffer=torch.tensor([[[0.0, 0.8]]])))["sensor", "depth"]
        tensor([[[0.5000, 2.0000]]])
    """

    reads_previous_frame = False
    needs_camera = False

    def __init__(
        self,
        kind: geometry.DepthKind,
        *,
        intrinsics: Intrinsics | None = None,
        near_m: float | None = None,
        far_m: float | None = None,
        scale_m: float | None = None,
        nothing: float | None = None,
        sky: float | None = None,
        baseline_m: float | None = None,
        channels_last: bool = False,
        in_keys: Keys = "depth",
        out_keys: Keys = ("sensor", "depth"),
    ) -> None:
        options: dict[str, Any] = {"kind": kind, "near_m": near_m, "far_m": far_m}
        options |= {"scale_m": scale_m, "nothing": nothing, "sky": sky, "baseline_m": baseline_m}
        # Without pixels, the conversion checks its options alone, as in the adapters below.
        K = None if intrinsics is None else torch.eye(3)
        geometry.adapt_depth(torch.empty(1, 0, 0), K=K, **options)
        shape = ("H", "W", 1) if channels_last else base.DEPTH.shape
        reads = Reads(shape, "float" if scale_m is None else "any")
        super().__init__(intrinsics, [reads], in_keys, out_keys)
        check_distinct_keys(self)
        self.options = options
        self.channels_last = channels_last

    def compute(self, depth: Tensor, K: Tensor | None = None) -> tuple[Tensor]:
        """Returns depth along the optical axis."""
        depth = depth.movedim(-1, -3) if self.channels_last else depth
        depth = depth.to(base.signed_type(depth.dtype))
        return (geometry.adapt_depth(depth, K=self.K if K is None else K, **self.options),)

    def output_specs(self, depth: TensorSpec, *camera: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded spec of depth's size."""
        *batch, height, width, _ = depth.shape
        size = (*batch, 1, height, width) if self.channels_last else depth.shape
        dtype = depth.dtype if depth.dtype.is_floating_point else torch.float32
        return (Unbounded(size, device=depth.device, dtype=dtype),)


class AdaptPose(MapTransform):
    """Converts poses of any convention to `world_from_cam` of a camera with OpenCV's axes.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | a pose | `("sensor", "world_from_cam")` | float64 `[*B, 4, 4]` | rigid | m |

    Convention and further arguments: see `flowrep.geometry.adapt_pose`. It also converts poses of
    bodies, e.g. `[*B, N, 7]`, with `axes="opencv"`, since the axes of a body do not matter; a body
    whose numbers are all `nan` is absent. In a left-handed world (`"unreal"`, `"unity"`) give the
    camera's axes, which convert the world too.

    Args:
        check: whether to check that poses are rigid, of envs that are reset and at the root of
            batches, not in steps. On a GPU, which waits for the check, it is made only where all
            envs are reset.

    Raises:
        ValueError: an option is unknown; in calls with `check`, a pose isn't rigid.

    Example:
        >>> from tensordict import TensorDict
        >>> adapt = AdaptPose(layout="xyz_wxyz", axes="x_forward_z_up", in_keys="pose")
        >>> td = adapt(TensorDict(pose=torch.tensor([5.0, 6.0, 7.0, 1.0, 0.0, 0.0, 0.0])))
        >>> td["sensor", "world_from_cam"][:3, 2:]  # forward is the world's x; the position
        tensor([[1., 5.],
                [0., 6.],
                [0., 7.]], dtype=torch.float64)
    """

    def __init__(
        self,
        *,
        layout: geometry.PoseLayout = "matrix",
        direction: geometry.PoseDirection = "camera_to_world",
        axes: geometry.CameraAxes = "opencv",
        check: bool = True,
        in_keys: Keys = "pose",
        out_keys: Keys = ("sensor", "world_from_cam"),
    ) -> None:
        options: dict[str, Any] = {"layout": layout, "direction": direction, "axes": axes}
        geometry.adapt_pose(torch.empty(0, *POSE_SHAPES.get(layout, ())), **options)
        super().__init__([Reads(POSE_SHAPES[layout], "float")], in_keys, out_keys)
        check_distinct_keys(self)
        self.options = options
        self.check = bool(check)

    def compute(self, pose: Tensor) -> tuple[Tensor]:
        """Returns the pose, unchecked."""
        return (geometry.adapt_pose(pose, check=False, **self.options),)

    def _check_values(self, tensordict: TensorDictBase, *, waits: bool = False) -> None:
        if not self.check or tensordict.get(self.in_keys[0], None) is None:
            return
        (pose,) = self._inputs(tensordict)
        if not (base.has_values(pose) and (waits or pose.is_cpu)):
            return
        own_dims = len(self.reads[0].shape)
        if pose.ndim > tensordict.ndim + own_dims:  # of bodies
            is_absent = pose.flatten(-own_dims).isnan().all(-1)
            if is_absent.all():
                return
            # In place of the absent ones, so that an error names the right row.
            mask = is_absent.reshape(*is_absent.shape, *[1] * own_dims)
            pose = torch.where(mask, pose[~is_absent][0], pose)
        geometry.adapt_pose(pose, check=True, **self.options)

    def output_specs(self, pose: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded float64 spec."""
        batch = pose.shape[: -len(self.reads[0].shape)]
        return (Unbounded((*batch, 4, 4), device=pose.device, dtype=torch.float64),)


class AdaptFlow(MapTransform):
    """Converts measured flow of any convention to p_t − p_t' on the current frame's grid.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | flow | `"raw"` | float `[*B, 2, H, W]` | any | px/step |
    | `"flow_valid"`, if there | | | | |

    Where flow's mask (not read with `channels_last`) is False, raw is nan, which `FlowFactorize`
    takes as unknown.

    Convention and further arguments: see `flowrep.geometry.adapt_flow`.

    Args:
        channels_last: whether the env's flow is `[*B, H, W, 2]`.

    Raises:
        ValueError: an option is unknown, or the grid is the previous frame's.

    Example:
        >>> from tensordict import TensorDict
        >>> backward = torch.tensor([-3.0, 1.0]).reshape(2, 1, 1)
        >>> adapt = AdaptFlow(direction="backward", grid="current", in_keys="flow")
        >>> adapt(TensorDict(flow=backward))["raw"].flatten()
        tensor([ 3., -1.])
    """

    def __init__(
        self,
        *,
        direction: geometry.Direction,
        grid: geometry.Grid,
        channels: geometry.Channels = "uv",
        channels_last: bool = False,
        in_keys: Keys = "flow",
        out_keys: Keys = "raw",
    ) -> None:
        options: dict[str, Any] = {"direction": direction, "grid": grid, "channels": channels}
        geometry.adapt_flow(torch.empty(2, 0, 0), **options)
        reads = Reads(("H", "W", 2), "float", spans_step=True) if channels_last else base.FLOW
        super().__init__([reads], in_keys, out_keys)
        check_distinct_keys(self)
        self.options = options
        self.channels_last = channels_last

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        (flow,) = super()._tensors(tensordict)
        if self.channels_last:
            return [flow]
        return [masked_flow(flow, self.in_keys[0], tensordict)]

    def compute(self, flow: Tensor) -> tuple[Tensor]:
        """Returns flow in flowrep's convention."""
        flow = flow.movedim(-1, -3) if self.channels_last else flow
        return (geometry.adapt_flow(flow, **self.options),)

    def output_specs(self, flow: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded spec of flow's size."""
        *batch, height, width, _ = flow.shape
        size = (*batch, 2, height, width) if self.channels_last else flow.shape
        return (Unbounded(size, device=flow.device, dtype=flow.dtype),)


class Plane(MapTransform):
    """A picture of depth or ids as a map `[*B, 1, H, W]`.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `[*B, H, W]` or `[*B, H, W, C]` | one key | `[*B, 1, H, W]` | as read | |

    Unsigned integers of 16 bits and more become int64, as PyTorch hardly computes with them.

    Args:
        layout: `"hw"` or `"hwc"`, of one channel, or of an id and its type.
        type: the type of bodies. The id i of another type t becomes 100,000 (1 + t) + i, so that
            it isn't taken for a body's; negative ids, where nothing is, stay.
        if_colours: of ids: what to do if they are colours, which have more channels.

    Raises:
        ValueError: the picture has other channels.
    """

    def __init__(
        self, layout: MapLayout, *, type: int | None = None, if_colours: str = "",
        in_keys: Keys, out_keys: Keys,
    ) -> None:  # fmt: skip
        channels = () if layout == "hw" else (1,) if type is None else (2,)
        super().__init__([Reads(("H", "W", *channels))], in_keys, out_keys)
        self.type, self.if_colours = type, if_colours

    def _inputs(self, source: Any) -> list[Any]:
        picture = source.get(self.in_keys[0], None)
        if picture is not None and self.if_colours:
            # The last size is a channel's, or the width of a picture without channels.
            *_, last = picture.shape
            if last in (3, 4) and picture.dtype is torch.uint8:
                says = f"holds colours, {picture.dtype} {list(picture.shape)}, which are no ids"
                raise ValueError(f"{self.in_keys[0]!r} {says}: {self.if_colours}")
        return super()._inputs(source)

    def compute(self, picture: Tensor) -> tuple[Tensor]:
        """Returns the map."""
        picture = picture.to(base.signed_type(picture.dtype))
        ids = picture[..., 0] if len(self.reads[0].shape) == 3 else picture
        if self.type is not None:
            kind = picture[..., 1]
            other = torch.where(ids < 0, ids, _OTHER_TYPE * (1 + kind) + ids)
            ids = torch.where(kind == self.type, ids, other)
        return (ids.unsqueeze(-3),)

    def output_specs(self, picture: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded spec."""
        *batch, height, width = picture.shape[: picture.ndim - len(self.reads[0].shape) + 2]
        shape = (*batch, 1, height, width)
        return (Unbounded(shape, device=picture.device, dtype=base.signed_type(picture.dtype)),)


class BodyRows:
    """Assigns each body a row for as long as it exists, in worlds where bodies come and go.

    `InstanceMotion` compares row i of this step's poses with row i of the previous step's. A row
    must therefore stay with its body, and must be empty for a step before another body takes it.
    Empty rows hold nan, so that flow is unknown there; the next body's pose would look like a jump.

    Args:
        count: the number of rows, enough for all bodies that exist at once and all that have just
            left.

    Example:
        >>> rows = BodyRows(3)
        >>> imp, demon = torch.eye(4), torch.eye(4)
        >>> rows({"imp": imp, "demon": demon})[:, 0, 0]
        tensor([1., 1., nan], dtype=torch.float64)
        >>> rows({"demon": demon, "cacodemon": imp})[:, 0, 0]  # the imp's row stays empty first
        tensor([nan, 1., 1.], dtype=torch.float64)
        >>> labels = torch.tensor([[[0, 9, 5]]])
        >>> rows.instance(labels, {9: "demon", 5: "cacodemon"})
        tensor([[[0, 2, 3]]])
    """

    def __init__(self, count: int) -> None:
        self.count = checked_count("count", count)
        self.clear()

    def clear(self) -> None:
        """Forgets all bodies; call it at each reset."""
        self._row_of: dict[Hashable, int] = {}

    def __call__(self, poses: Mapping[Hashable, Tensor]) -> Tensor:
        """Returns the poses `[count, 4, 4]`, float64; ValueError if there are too few rows."""
        free = sorted(set(range(self.count)) - set(self._row_of.values()))
        arrived = [body for body in poses if body not in self._row_of]
        if len(arrived) > len(free):
            raise ValueError(
                f"{len(arrived)} bodies arrive and {len(free)} of {self.count} rows are free: "
                f"use BodyRows({self.count + len(arrived) - len(free)}) or more"
            )
        self._row_of = {body: row for body, row in self._row_of.items() if body in poses}
        self._row_of |= dict(zip(arrived, free))
        out = torch.full((self.count, 4, 4), torch.nan, dtype=torch.float64)
        for body, row in self._row_of.items():
            out[row] = torch.as_tensor(poses[body])
        return out

    def instance(self, labels: Tensor, body_of: Mapping[int, Hashable]) -> Tensor:
        """Returns `("sensor", "instance")`: 1 + the row of each pixel's body, or 0.

        `body_of` gives the body of each label, which may change every step.
        """
        out = torch.zeros_like(labels)
        for label, body in body_of.items():
            if body in self._row_of:
                out[labels == label] = 1 + self._row_of[body]
        return out
