"""Motions of the camera and of bodies, for flow: from their poses, or from flow and depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from flowrep import geometry
from flowrep.transforms import base
from flowrep.transforms.base import Keys, Reads, RecurrentTransform, as_keys, check_choice
from flowrep.transforms.flow import CAMERA, DEPTH_KEY, CameraTransform, Intrinsics

_POSES: Keys = [("sensor", "world_from_cam"), ("sensor", "world_from_body")]
_PICTURE = Reads((3, "kH", "kW"), "integer")
# EstimateCameraMotion's outputs, with their keys.
_ESTIMATES: dict[str, NestedKey] = {
    "motion": ("sensor", "prev_from_curr"),
    "inlier_share": ("sensor", "inlier_share"),
    "covariance": ("sensor", "motion_covariance"),
    "valid": ("sensor", "motion_valid"),
}


class CameraMotion(RecurrentTransform):
    """The camera's motion, for envs that give only its pose.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "world_from_cam")` | `("sensor", "prev_from_curr")` | float32 `[*B, 4, 4]` | | m |

    Convention: `prev_from_curr` takes a point from the current camera's frame into the previous
    camera's (Eq. 11 of the paper). Poses are camera-to-world of a camera with OpenCV's axes (see
    `AdaptPose`), of any float type; use float64 in large worlds. The motion is composed in float64
    and returned in float32. After a reset it is exactly the identity.

    The previous step's pose is read from the TensorDict passed to `step`, as `FrameStack` reads its
    stack. A replay batch without stored motions has to be a trajectory, as described there.

    Example:
        >>> from tensordict import TensorDict
        >>> poses = torch.eye(4).repeat(3, 1, 1)
        >>> poses[:, 0, 3] = torch.tensor([0.0, 2.0, 7.0])  # the third begins a new episode
        >>> done = torch.tensor([[False], [True], [False]])
        >>> td = TensorDict({"sensor": {"world_from_cam": poses}, "next": {"done": done}}, [3])
        >>> td.names = ["time"]
        >>> CameraMotion()(td)["sensor", "prev_from_curr"][:, 0, 3]
        tensor([0., 2., 0.])
    """

    def __init__(
        self,
        *,
        in_keys: Keys = ("sensor", "world_from_cam"),
        out_keys: Keys = ("sensor", "prev_from_curr"),
    ) -> None:
        super().__init__([base.POSE], in_keys, out_keys)

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor]:
        """Returns `prev_from_curr`."""
        return (geometry.relative_motion(before[0], now[0]),)

    def output_specs(self, pose: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded float32 spec."""
        return (Unbounded(pose.shape, device=pose.device, dtype=torch.float32),)


class InstanceMotion(RecurrentTransform):
    """The bodies' motions relative to the camera, for simulators that give the bodies' poses.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "world_from_cam")` | `("sensor", "instance_motion")` | float32 | | m |
    | `("sensor", "world_from_body")` | | `[*B, 1 + N, 4, 4]` | | |

    Convention: see `flowrep.geometry.instance_motion`. N poses, of bodies alone, become 1 + N
    motions: row 0 is the static world's, which has no pose. `InstanceIds` converts a simulator's
    instance ids to these rows, and `RawFlow` reads both. For the previous step's poses see
    `CameraMotion`.

    Args:
        in_keys: keys of the camera's pose `[*B, 4, 4]` and the bodies' poses `[*B, N, 4, 4]`,
            metres.

    Example:
        >>> from tensordict import TensorDict
        >>> camera, body = torch.eye(4).repeat(2, 1, 1), torch.eye(4).repeat(2, 1, 1, 1)
        >>> body[1, 0, 0, 3] = 0.5  # the only body moved half a metre along x
        >>> sensor = {"world_from_cam": camera, "world_from_body": body}
        >>> td = TensorDict({"sensor": sensor, "next": {"done": torch.zeros(2, 1).bool()}}, [2])
        >>> td.names = ["time"]
        >>> InstanceMotion()(td)["sensor", "instance_motion"][..., 0, 3]
        tensor([[ 0.0000,  0.0000],
                [ 0.0000, -0.5000]])
    """

    def __init__(
        self, *, in_keys: Keys | None = None, out_keys: Keys = ("sensor", "instance_motion")
    ) -> None:
        keys = _POSES if in_keys is None else in_keys
        super().__init__([base.POSE, base.BODIES], keys, out_keys)

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor]:
        """Returns `instance_motion`."""
        (camera_before, bodies_before), (camera, bodies) = before, now
        return (geometry.instance_motion(camera_before, camera, bodies_before, bodies),)

    def output_specs(self, camera: TensorSpec, bodies: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded float32 spec."""
        *batch, count, _, _ = bodies.shape
        shape = (*batch, 1 + count, 4, 4)
        return (Unbounded(shape, device=bodies.device, dtype=torch.float32),)


class PreviousIntrinsics(RecurrentTransform):
    """The previous step's K, for envs whose camera zooms or focuses.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "K")` | `("sensor", "prev_K")` | as K, float `[*B, 3, 3]` | | px |

    The flow transforms read it under the key that their `prev_intrinsics` names. After a reset it
    is the current K. For how it reads the previous step see `CameraMotion`.

    Example:
        >>> from tensordict import TensorDict
        >>> K = torch.tensor([[40.0, 0.0, 4.0], [0.0, 50.0, 3.0], [0.0, 0.0, 1.0]]).repeat(2, 1, 1)
        >>> K[1, 0, 0] = 44.0
        >>> td = TensorDict({"sensor": {"K": K}, "next": {"done": torch.zeros(2, 1).bool()}}, [2])
        >>> td.names = ["time"]
        >>> PreviousIntrinsics()(td)["sensor", "prev_K"][:, 0, 0]
        tensor([40., 40.])
    """

    def __init__(
        self, *, in_keys: Keys = ("sensor", "K"), out_keys: Keys = ("sensor", "prev_K")
    ) -> None:
        super().__init__([CAMERA], in_keys, out_keys)

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor]:
        """Returns the previous step's K."""
        return (before[0],)

    def output_specs(self, K: TensorSpec) -> tuple[TensorSpec]:
        """Returns K's spec."""
        return (K.clone(),)


class EstimateCameraMotion(CameraTransform):
    """The camera's motion estimated from flow and depth, for envs and robots that give no pose.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"raw"`, px/step | `("sensor", "prev_from_curr")` | float32 `[*B, 4, 4]` | rigid | m |
    | `("sensor", "depth")`, m | `("sensor", "inlier_share")` | float32 `[*B, 1]` | 0 … 1 | |
    | `picture`, if given | `("sensor", "motion_covariance")` | float32 `[*B, 6, 6]` | | rad, m |
    | `prior`, if given | `("sensor", "motion_valid")` | bool `[*B, 1]` | | |
    | `"raw_valid"`, if there | | | | |

    Convention, and where it fails: see `flowrep.geometry.camera_motion`. The result depends on the
    frame alone, so it is the same in an env, in any batch and on replay samples. If no motion can
    be estimated from a frame, `motion_valid` is False and the motion is the prior's or, without
    one, the identity.

    Put it after the transform that writes raw flow and before `FlowFactorize`, whose ego and object
    flow then need no pose.

    Args:
        intrinsics: K `[3, 3]` of the maps, pixels, or the env's key for it, `[*B, 3, 3]`; see
            `RawFlow`, as for `prev_intrinsics`.
        picture: key of the current picture, uint8 `[*B, 3, kH, kW]`, k ≥ 1. Give it if raw flow is
            estimated: flow on plain surfaces and along edges, which is a guess, is then ignored.
        prior: key of the expected motion, `[*B, 4, 4]`, such as odometry's.
        outputs: which of `"motion"`, `"inlier_share"`, `"covariance"` and `"valid"` to write.
        in_keys: raw flow (px/step, unscaled) and depth.
        out_keys: one key for each output; the table's by default.

    Raises:
        ValueError: see `RawFlow`.

    Example:
        >>> from tensordict import TensorDict
        >>> from flowrep.geometry import ego_flow
        >>> K = torch.tensor([[40.0, 0.0, 10.0], [0.0, 50.0, 8.0], [0.0, 0.0, 1.0]])
        >>> depth = torch.linspace(2.0, 9.0, 320).reshape(1, 16, 20)
        >>> ahead = torch.eye(4)
        >>> ahead[2, 3] = 0.5
        >>> raw = ego_flow(depth, K, ahead).flow
        >>> td = EstimateCameraMotion(K)(TensorDict({"raw": raw, "sensor": {"depth": depth}}))
        >>> td["sensor", "prev_from_curr"][2, 3].round(decimals=4), td["sensor", "motion_valid"]
        (tensor(0.5000), tensor([True]))
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        prev_intrinsics: NestedKey | None = None,
        picture: NestedKey | None = None,
        prior: NestedKey | None = None,
        outputs: Sequence[str] = tuple(_ESTIMATES),
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        check_choice("outputs", outputs, _ESTIMATES)
        reads = [base.FLOW, base.DEPTH]
        keys = as_keys(["raw", DEPTH_KEY] if in_keys is None else in_keys)
        for key, layout in ((picture, _PICTURE), (prior, base.MOTION)):
            if key is not None:
                reads.append(layout)
                keys += as_keys([key])
        written = [_ESTIMATES[name] for name in outputs] if out_keys is None else out_keys
        options: Any = {"writes": len(outputs), "prev_intrinsics": prev_intrinsics}
        super().__init__(intrinsics, reads, keys, written, **options)
        self.outputs = tuple(outputs)
        self.has_picture, self.has_prior = picture is not None, prior is not None

    def compute(self, raw: Tensor, depth: Tensor, *more: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs."""
        # In the keys' order: picture, prior, K and previous K, those that there are.
        rest = list(more)
        picture = rest.pop(0) if self.has_picture else None
        if picture is not None:
            k, size = picture.shape[-1] // depth.shape[-1], depth.shape[-2:]
            # `camera_motion` refuses pictures of other sizes.
            if k > 1 and picture.shape[-2:] == (k * size[0], k * size[1]):
                flat = picture.reshape(-1, *picture.shape[-3:]).float()
                picture = functional.avg_pool2d(flat, k).reshape(*picture.shape[:-2], *size)
        prior = rest.pop(0) if self.has_prior else None
        K = self.K if self.K is not None else rest.pop(0)
        prev_K = rest.pop() if rest else None
        motion, share, covariance, valid = geometry.camera_motion(
            raw, depth, K, prev_K=prev_K, picture=picture, prior=prior
        )
        estimates = {
            "motion": motion.float(),
            "inlier_share": share.float().unsqueeze(-1),
            "covariance": covariance.float(),
            "valid": valid.unsqueeze(-1),
        }
        return tuple(estimates[name] for name in self.outputs)

    def output_specs(self, raw: TensorSpec, *others: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns unbounded specs, one bounded to [0, 1] for the share, a boolean one for valid."""
        batch, device, float32 = raw.shape[:-3], raw.device, torch.float32
        specs = {
            "motion": Unbounded((*batch, 4, 4), device=device, dtype=float32),
            "inlier_share": Bounded(0.0, 1.0, shape=(*batch, 1), device=device, dtype=float32),
            "covariance": Unbounded((*batch, 6, 6), device=device, dtype=float32),
            "valid": Categorical(2, shape=(*batch, 1), device=device, dtype=torch.bool),
        }
        return tuple(specs[name] for name in self.outputs)
