"""Motions of the camera and of bodies, for flow, computed from their poses at every step."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from flowrep import geometry
from flowrep.transforms.base import MOTION, MOTIONS, Keys, Reads, RecurrentTransform, refuse_n_step

_CAMERA: NestedKey = ("sensor", "world_from_cam")
_BODIES: NestedKey = ("sensor", "world_from_body")


class PoseTransform(RecurrentTransform):
    """Base of transforms that write the motion between the poses of two steps.

    A subclass defines the motion between two sets of poses.

    Args:
        reads: see `MapTransform`.
        in_keys: see `MapTransform`.
        out_keys: one key.
    """

    def __init__(self, reads: Sequence[Reads], in_keys: Keys, out_keys: Keys) -> None:
        super().__init__(reads, in_keys, out_keys)
        if len(self.out_keys) != 1:
            raise ValueError(f"{type(self).__name__} writes 1 key, out_keys has {self.out_keys}")

    @abstractmethod
    def between(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> Tensor:
        """Returns the motion from the previous step's poses to the current ones."""

    def compute(self, *poses: Tensor) -> tuple[Tensor]:
        """Returns the motion at an episode's first frame, where nothing moves."""
        return (self.between(poses, poses),)

    @property
    def carried_keys(self) -> list[NestedKey]:
        """The poses of the step before."""
        return self.in_keys

    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor]:
        """Returns the motion between two steps."""
        return (self.between(before, now),)

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the motions of a replay batch, at its root and under `"next"`."""
        key = self.out_keys[0]
        now = self._read(tensordict)
        if tensordict.get(key, None) is None:
            tensordict.set(key, self._along_trajectory(tensordict, now))
        following = tensordict.get("next", None)
        if following is None or following.get(key, None) is not None:
            return tensordict  # stored: correct even if the next frame is several steps ahead
        if any(k in following.keys(True) for k in self.in_keys):
            refuse_n_step(tensordict, key)
            following.set(key, self.between(now, self._read(following)))
            tensordict.set("next", following)
        return tensordict

    def _along_trajectory(self, tensordict: TensorDictBase, now: Sequence[Tensor]) -> Tensor:
        """Returns the motion to each step of a trajectory, without motion at an episode's start."""
        done, time = self._trajectory(tensordict, self.out_keys[0])
        begins = torch.cat([torch.ones_like(done.narrow(time, 0, 1)), _but_last(done, time)], time)
        before = [
            torch.where(
                expand_as_right(begins, pose),
                pose,
                torch.cat([pose.narrow(time, 0, 1), _but_last(pose, time)], time),
            )
            for pose in now
        ]
        return self.between(before, now)


class CameraMotion(PoseTransform):
    """The camera's motion, for envs that give only its pose.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "world_from_cam")` | `("sensor", "prev_from_curr")` | float32 `[*B, 4, 4]` | | m |

    Convention: `prev_from_curr` maps a point from the current camera's frame to the previous
    camera's (Eq. 11 of the paper). Poses are camera-to-world of a camera with OpenCV's axes (see
    `AdaptPose`), of any float type; use float64 for large worlds. The motion is composed in float64
    and returned in float32. After a reset it is exactly the identity.

    The previous step's pose is read from the TensorDict passed to `step`; no state is kept between
    calls. In a replay buffer the stored root motion and the two poses give the next motion,
    shuffled or not. A motion stored under `"next"` is left unchanged; n-step returns need it
    stored. A batch without a stored motion has to be a trajectory, with a dimension named "time"
    and `("next", "done")`; its first frame counts as an episode's first.

    Args:
        in_keys: key of the pose.
        out_keys: key of the motion.

    Example:
        >>> import torch
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
        super().__init__([MOTION], in_keys, out_keys)

    def between(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> Tensor:
        """Returns `prev_from_curr`."""
        return geometry.relative_motion(before[0], now[0])

    def output_specs(self, pose: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded float32 spec."""
        return (Unbounded(pose.shape, device=pose.device, dtype=torch.float32),)


class InstanceMotion(PoseTransform):
    """The bodies' motions relative to the camera, for simulators that give their bodies' poses.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "world_from_cam")` | `("sensor", "instance_motion")` | float32 | | m |
    | `("sensor", "world_from_body")` | | `[*B, 1 + N, 4, 4]` | | |

    Convention: row 0 is the static world's, the camera's own motion; row 1 + i maps a point fixed
    to body i from the current camera's frame to its place in the previous camera's. A static body's
    row is bitwise equal to row 0. `InstanceIds` converts a simulator's segmentation ids to these
    rows, and `RawFlow` reads both.

    The choice of a body's own origin and axes doesn't matter. Like `CameraMotion`, it reads the
    previous step's poses from the TensorDict passed to `step` and keeps no state.

    Args:
        in_keys: keys of the camera's pose `[*B, 4, 4]` and the bodies' poses `[*B, N, 4, 4]`,
            metres.
        out_keys: key of the motions.

    Example:
        >>> import torch
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
        super().__init__(
            [MOTION, MOTIONS], [_CAMERA, _BODIES] if in_keys is None else in_keys, out_keys
        )

    def between(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> Tensor:
        """Returns `instance_motion`."""
        return geometry.instance_motion(before[0], now[0], before[1], now[1])

    def output_specs(self, camera: TensorSpec, bodies: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded float32 spec."""
        *batch, count, _, _ = bodies.shape
        shape = (*batch, 1 + count, 4, 4)
        return (Unbounded(shape, device=bodies.device, dtype=torch.float32),)


def _but_last(values: Tensor, dim: int) -> Tensor:
    return values.narrow(dim, 0, values.shape[dim] - 1)
