"""Poses to motions: nothing moves at a reset, whoever resets; nothing is remembered."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp

from flowrep import transforms as T
from flowrep.transforms.base import IDS, RecurrentTransform
from tests.transforms.fake_env import INTRINSICS, FakeSensorEnv, frame_motions, moments


def test_a_step_from_an_earlier_tensordict_moves_from_its_pose():
    env = TransformedEnv(FakeSensorEnv((2,)), T.CameraMotion(out_keys="motion"))
    action = torch.zeros(2, dtype=torch.long)
    first = env.reset().set("action", action)
    second = step_mdp(env.step(first.clone())).set("action", action)
    env.step(second)
    again = env.step(first.clone())  # the env itself has gone on: from pose 0 to pose 3
    turned, once = again["next", "motion"], second["motion"]
    for i in (0, 1):
        assert turned[i, :3, :3].trace() < once[i, :3, :3].trace() - 1e-4
    assert not T.CameraMotion().state_dict()


class Brightness(RecurrentTransform):
    """The running sum of ids, a state of another type than its input."""

    def __init__(self, carried):
        super().__init__([IDS], ("sensor", "instance"), "sum")
        self.carried = carried

    @property
    def carried_keys(self):
        return [self.carried]

    def advance(self, before, now):
        return (before[0].float() + now[0].float(),)

    def output_specs(self, ids):
        return (Unbounded(ids.shape, dtype=torch.float32),)


class WideIds(FakeSensorEnv):
    def _observe(self):
        seen = super()._observe()
        seen["sensor", "instance"] = seen["sensor", "instance"].to(torch.uint16)
        return seen


@pytest.mark.parametrize("carried", ["sum", ("sensor", "instance")])
@pytest.mark.parametrize("make", [FakeSensorEnv, WideIds])
def test_a_state_may_be_of_another_type_and_ids_of_any(carried, make):
    td = TransformedEnv(make(), Brightness(carried)).rollout(2)
    assert td["next", "sum"].dtype == torch.float32


def test_two_cameras_that_share_a_pose_s_key_are_refused():
    def camera():
        adapt = T.AdaptPose(in_keys=("sensor", "world_from_cam"), out_keys="pose")
        return Compose(adapt, T.CameraMotion(in_keys="pose"))

    TransformedEnv(FakeSensorEnv(), camera()).rollout(2)
    with pytest.raises(ValueError, match="AdaptPose writes to 'pose', which CameraMotion"):
        TransformedEnv(FakeSensorEnv(), Compose(camera(), camera())).rollout(2)


def test_two_cameras_that_share_a_motion_s_key_are_refused_in_a_batch():
    td = FakeSensorEnv().rollout(2)
    poses = [("sensor", "world_from_cam"), "other"]  # which isn't needed to see it
    cameras = Compose(*(T.CameraMotion(in_keys=key, out_keys="motion") for key in poses))
    with pytest.raises(ValueError, match="earlier transform write 'motion'"):
        cameras(td)


class WithRows(FakeSensorEnv):
    """Has a row for the static world before the bodies' poses, or ids whose spec counts nothing."""

    def __init__(self, *, static_row=False, ids=None):
        super().__init__()
        self.static_row = static_row
        spec = self.observation_spec["sensor"].clone()
        spec["world_from_body"] = Unbounded((2 + static_row, 4, 4), dtype=torch.float64)
        spec["instance"] = spec["instance"] if ids is None else ids
        self.observation_spec["sensor"] = spec

    def _observe(self):
        seen = super()._observe()
        if self.static_row:
            rows = [torch.eye(4).double()[None], seen["sensor", "world_from_body"]]
            seen["sensor", "world_from_body"] = torch.cat(rows)
        return seen


def test_no_body_gets_its_neighbours_motion():
    def flow(**options):
        keys = [("sensor", "depth"), ("sensor", "instance"), "motions"]
        stack = Compose(T.InstanceMotion(out_keys="motions"), T.RawFlow(INTRINSICS, in_keys=keys))
        return TransformedEnv(WithRows(**options), stack).rollout(1)["next", "raw"]

    shape = (1, 5, 7)
    for dtype in (torch.uint8, torch.uint16):
        assert flow(ids=Bounded(0, 2, shape, dtype=dtype)).isfinite().all()
    with pytest.raises(ValueError, match=r"ids from 0 to 2.*4 rows.*1 \+ N.*bodies alone"):
        flow(static_row=True)
    for ids in (Unbounded(shape, dtype=torch.uint8), Bounded(0, 255, shape, dtype=torch.uint8)):
        with pytest.raises(ValueError, match=r"any id.*InstanceIds"):
            flow(ids=ids)


def test_bodies_of_a_batch_are_counted_if_instance_ids_is_beside_the_flow():
    def flow(*bodies):
        td, ids = moments(2), T.InstanceIds(bodies, static_ids=[0, 2], in_keys="ids")
        return Compose(ids, T.RawFlow(INTRINSICS))(td.set("ids", td["sensor", "instance"]))["raw"]

    assert flow(1, 2).any()
    with pytest.raises(ValueError, match=r"ids from 0 to 1.*3 rows.*1 \+ N"):
        flow(1)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_rounds_no_motion(dtype):
    td = Compose(T.RawFlow(WIDE), T.EstimateCameraMotion(WIDE))(wide_frames())
    with torch.autocast("cpu", dtype=dtype):
        other = Compose(T.RawFlow(WIDE), T.EstimateCameraMotion(WIDE))(wide_frames())
    assert torch.equal(other["sensor", "prev_from_curr"], td["sensor", "prev_from_curr"])


def wide_frames(count: int = 3) -> TensorDict:
    """Returns frames of 16 x 24 with a body in a corner; the camera turns and drives ahead."""
    depth = 2 + 6 * torch.rand(count, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    camera = torch.stack([frame_motions(1, env)[0] for env in range(count)])
    bodies = torch.stack([camera, camera], 1)
    bodies[:, 1, :2, 3] += 0.4
    instance = torch.zeros(count, 1, 16, 24, dtype=torch.uint8)
    instance[..., 10:, :9] = 1
    sensor = {"depth": depth, "instance": instance, "instance_motion": bodies}
    return TensorDict({"sensor": sensor, "truth": camera}, [count])


WIDE = [[20.0, 0.0, 11.0], [0.0, 22.0, 9.0], [0.0, 0.0, 1.0]]


def test_flow_and_depth_tell_ego_and_object_flow_without_a_pose():
    td = wide_frames()
    exact = td.clone()
    exact["sensor", "prev_from_curr"] = exact["truth"]
    Compose(T.RawFlow(WIDE), T.FlowFactorize(WIDE))(exact)
    estimated = Compose(T.RawFlow(WIDE), T.EstimateCameraMotion(WIDE), T.FlowFactorize(WIDE))(td)
    for key in (("sensor", "prev_from_curr"), "ego", "obj"):
        torch.testing.assert_close(estimated[key], exact[key], rtol=0, atol=1e-4)
    assert estimated["sensor", "motion_valid"].all()
    share = (td["sensor", "instance"] == 0).float().mean()
    torch.testing.assert_close(estimated["sensor", "inlier_share"], share.expand(3, 1))
    assert estimated["sensor", "motion_covariance"].shape == (3, 6, 6)


def test_pixels_of_unknown_raw_flow_tell_nothing_of_the_motion():
    td = T.RawFlow(WIDE)(wide_frames())
    td["raw"][..., :14], td["raw_valid"][..., :14] = 0.0, False  # most of the picture
    motion = T.EstimateCameraMotion(WIDE, outputs=["motion"])(td)["sensor", "prev_from_curr"]
    torch.testing.assert_close(motion, td["truth"], rtol=0, atol=1e-4)


def test_an_estimate_reads_the_picture_the_prior_and_k_where_it_is_told():
    td = T.RawFlow(WIDE)(wide_frames())
    td["sensor", "rgb"] = torch.full((3, 3, 16, 24), 9, dtype=torch.uint8)
    td["odometry"], td["K"] = td["truth"].clone(), torch.tensor(WIDE).expand(3, 3, 3)
    estimate = T.EstimateCameraMotion(
        "K", prev_intrinsics="K", picture=("sensor", "rgb"), prior="odometry"
    )
    assert estimate.in_keys == ["raw", ("sensor", "depth"), ("sensor", "rgb"), "odometry", "K"]
    td = estimate(td)
    assert not td["sensor", "motion_valid"].any()  # the picture is plain
    assert torch.equal(td["sensor", "prev_from_curr"], td["odometry"])
    td["sensor", "rgb"] = torch.zeros(3, 3, 32, 49, dtype=torch.uint8)  # twice 16 x 24 is 32 x 48
    with pytest.raises(ValueError, match=r"one \(height, width\)"):
        estimate(td)
