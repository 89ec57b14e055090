"""Flow transforms: hand-worked values, units, masks, what stands still."""

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs
from torchrl.envs.transforms import Compose, RenameTransform

from flowrep import transforms as T
from flowrep.geometry.pose import rotation_from_vector
from tests.geometry.scenes import flow_pixel_by_pixel
from tests.transforms.fake_env import INTRINSICS, WALKER, FakeSensorEnv, frame, moments
from tests.transforms.oracles import brightening

# fx = 40, fy = 20, cx = 2, cy = 1: pixel (column 1, row 0) sits at x~ = -0.5, y~ = -0.5.
K = [[40.0, 0.0, 2.0], [0.0, 20.0, 1.0], [0.0, 0.0, 1.0]]


def view(depth_m: float, instance: list[list[int]], motions: torch.Tensor) -> TensorDict:
    """Returns a view of bodies before a wall, all at one depth."""
    ids = torch.tensor([instance], dtype=torch.uint8)
    sensor = {"depth": torch.full(ids.shape, depth_m), "instance": ids}
    sensor |= {"prev_from_curr": motions[0].clone(), "instance_motion": motions}
    return TensorDict({"sensor": sensor})


def scene() -> TensorDict:
    """Returns a 2 x 4 view at 8 m; the camera slid 0.4 m right, a body at (1, 0) rose 0.8 m."""
    motions = torch.eye(4).repeat(3, 1, 1)
    motions[:, 0, 3] = 0.4  # what is at x now was at x + 0.4 before
    motions[1, 1, 3] = 0.8  # y points down: the body was 0.8 m lower
    return view(8.0, [[0, 1, 0, 0], [0, 0, 0, 0]], motions)


@pytest.mark.parametrize("precision", [torch.float16, torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("other", [torch.float32, torch.float64], ids=str)
def test_whatever_the_float_types_raw_and_ego_round_alike(precision, other):
    td = TensorDict({"sensor": frame(env=1, episode=0, step=2)})
    for key, dtype in (("depth", precision), ("prev_from_curr", other), ("instance_motion", other)):
        td["sensor", key] = td["sensor", key].to(dtype)
    intrinsics = torch.tensor(INTRINSICS, dtype=other)
    intrinsics[0, 0] = 6.1  # not the same number in float32 and float64
    for stack in (
        Compose(T.RawFlow(intrinsics), T.FlowFactorize(intrinsics)),
        T.representation_stack(["obj"], intrinsics=intrinsics),
    ):
        obj = stack(td.clone())["obj"]
        still = (td["sensor", "instance"] != WALKER).expand(2, -1, -1)
        assert (obj[still] == 0).all()
        assert obj.dtype == torch.promote_types(precision, torch.float32)


def overtaken() -> TensorDict:
    """Returns a wall at 5 m and three bodies before a camera that slid 0.5 m right, 0.25 m down.

    Body 1 (column 1) was 6 m further back, behind the camera; body 2 (column 2) had no pose a step
    ago; body 3 (column 3) was 0.75 m further left relative to the camera.
    """
    motions = torch.eye(4).repeat(4, 1, 1)
    motions[:, :2, 3] = torch.tensor([0.5, 0.25])
    motions[1, 2, 3] = -6.0
    motions[2] = math.nan
    motions[3, 0, 3] = -0.25
    return view(5.0, [[0, 1, 2, 3]] * 2, motions)


WITH_MASK = {"outputs": ["ego", "obj", "valid"]}
STACKS = {
    "other keys": lambda K: Compose(
        T.RawFlow(K, out_keys=[("sensor", "flow")]),
        T.FlowFactorize(
            K,
            in_keys=[("sensor", "flow"), ("sensor", "depth"), ("sensor", "prev_from_curr")],
            **WITH_MASK,
        ),
        RenameTransform([("sensor", "flow")], ["raw"]),
    ),
    "in one pass": lambda K: T.RawFlow(K, outputs=["raw", "ego", "obj", "valid"]),
    "representation_stack": lambda K: T.representation_stack(["raw", "ego", "obj"], intrinsics=K),
}


@pytest.mark.parametrize("make", STACKS.values(), ids=list(STACKS))
def test_a_moving_camera_gives_bodies_of_unknown_flow_no_object_flow(make):
    td = make([[50.0, 0.0, 1.5], [0.0, 40.0, 0.5], [0.0, 0.0, 1.0]])(overtaken())
    # ego: 50 * 0.5 m / 5 m = 5 px to the left, 40 * 0.25 m / 5 m = 2 px up, on every pixel.
    ego = torch.tensor([-5.0, -2.0])[:, None, None].expand(2, 2, 4)
    torch.testing.assert_close(td["ego"], ego)
    # obj = raw - ego: 0 of the wall and where raw isn't known (raw taken as 0 would give +5, +2);
    # body 3: raw = 50 * 0.25 / 5 = 2.5 px to the right, and with the camera's part gone 7.5.
    obj = torch.zeros(2, 2, 4)
    obj[0, :, 3] = 7.5
    torch.testing.assert_close(td["obj"], obj)
    if "valid" in td:
        assert td["valid"].tolist() == [[[True, False, False, True]] * 2]


def test_a_mask_of_another_layout_is_refused_and_may_hold_whole_numbers():
    td = T.RawFlow(K)(scene())
    for wrong in (td["raw_valid"].float(), td["raw_valid"][0]):
        with pytest.raises(ValueError, match="raw_valid"):
            T.FlowFactorize(K)(td.clone().set("raw_valid", wrong))
    whole = td.clone().set("raw_valid", td["raw_valid"].to(torch.uint8))
    assert torch.equal(T.FlowFactorize(K)(whole)["obj"], T.FlowFactorize(K)(td)["obj"])


def test_a_second_pass_over_unknown_raw_flow_finds_it_unknown_again():
    td = scene()
    td["raw"] = torch.full((2, 2, 4), math.nan)
    split = T.FlowFactorize(K, outputs=["raw", "obj", "valid"])
    again = split(split(td).clone())
    assert not again["raw"].any()
    assert not again["obj"].any()
    assert not again["valid"].any()


def test_the_mask_beside_raw_flow_is_raw_s_own():
    td = scene()
    td["raw"] = torch.full((2, 2, 4), 1.5)
    td["sensor", "depth"][0, 1, 2] = math.nan
    keys = {"outputs": ["raw", "valid"], "out_keys": ["raw", "known"]}
    split = T.FlowFactorize(K, **keys)(td)
    assert split["raw_valid"].all()
    assert (~split["known"]).nonzero().tolist() == [[0, 1, 2]]
    alike = T.FlowFactorize(K, outputs=["raw", "valid"], out_keys=["raw", "raw_valid"])
    assert alike.out_keys == ["raw", "raw_valid"]


def test_noise_under_another_key_leaves_unknown_flow_unknown():
    td = T.RawFlow(K)(scene())
    td["raw_valid"] = torch.zeros_like(td["raw_valid"])
    noise = T.SensorNoise(sensors=["flow"], flow_sigma_px=0.1, out_keys=["noisy"])
    keys = ["noisy", ("sensor", "depth"), ("sensor", "prev_from_curr")]
    td = T.FlowFactorize(K, in_keys=keys, outputs=["obj", "valid"])(noise(td))
    assert not td["obj"].any()
    assert not td["valid"].any()


def test_raw_flow_that_would_be_scaled_twice_is_refused():
    with pytest.raises(ValueError, match="reads and writes raw"):
        T.FlowFactorize(K, outputs=["raw", "obj"], scale=2.0)
    split = T.FlowFactorize(K, outputs=["raw", "obj"], scale=2.0, out_keys=["twice", "obj"])
    td = split(T.RawFlow(K)(scene()))
    assert torch.equal(split(td.clone())["twice"], 2 * td["raw"])


@pytest.mark.parametrize("make", [T.RawFlow, T.FlowFactorize, T.EstimateCameraMotion])
def test_intrinsics_of_none_are_refused(make):
    with pytest.raises(TypeError, match="intrinsics is K"):
        make(None)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8])
def test_drift_of_odometry_leaves_no_object_flow_where_nothing_can_move(dtype):
    td = T.RawFlow(K)(scene())
    exact = T.FlowFactorize(K)(td.clone())["obj"]
    td["people"] = (td["sensor", "instance"] == 1).to(dtype)
    td["sensor", "prev_from_curr"][0, 3] += 0.02
    drifted = T.FlowFactorize(K, movable="people")(td.clone())["obj"]
    assert torch.equal(drifted != 0, td["people"].bool().expand(2, -1, -1))
    # fx * 0.02 m / 8 m = 0.1 px of the drift is left on who moves
    torch.testing.assert_close(drifted[:, 0, 1], exact[:, 0, 1] + torch.tensor([0.1, 0.0]))
    with pytest.raises(ValueError, match="movable"):
        T.FlowFactorize(K, outputs=["ego"], movable="people")


def street(batch: int = 3) -> TensorDict:
    """Returns views of 24 x 30 px: a floor before a wall, and a person who walks past the wall."""
    rows = torch.arange(24.0)[:, None]
    depth = torch.where(rows > 14, 60.0 / (rows - 12), 20.0).expand(batch, 1, 24, 30).clone()
    instance = torch.zeros(batch, 1, 24, 30, dtype=torch.uint8)
    depth[..., 8:16, 10:14], instance[..., 8:16, 10:14] = 12.0, 1
    depth[..., 0, 5:8] = torch.tensor([math.inf, math.nan, 0.0])
    motions = torch.eye(4).repeat(batch, 2, 1, 1)
    motions[..., 2, 3] = 0.8
    motions[:, 1, 0, 3] = 0.3
    sensor = {"depth": depth, "instance": instance, "instance_motion": motions}
    sensor["prev_from_curr"] = motions[:, 0].clone()
    return TensorDict({"sensor": TensorDict(sensor, [batch])}, [batch])


def test_drift_is_below_the_threshold_and_who_moves_above_it():
    K, td = torch.tensor([[30.0, 0, 15], [0, 30, 12], [0, 0, 1]]), street()
    quiet = T.FlowFactorize(K, noise_scales=3.0)
    exact = T.FlowFactorize(K)(T.RawFlow(K)(td))["obj"].clone()
    assert torch.equal(quiet(td.clone())["obj"], exact)
    td["sensor", "prev_from_curr"][1, :3, 3] += torch.tensor([0.02, 0.01, -0.02])
    turn = rotation_from_vector(torch.tensor([2e-3, -1e-3, 0.0]))
    td["sensor", "prev_from_curr"][2, :3, :3] = turn
    person = (td["sensor", "instance"] == 1).expand_as(exact)
    drifted = T.FlowFactorize(K)(td.clone())["obj"]
    assert (drifted[1:] != 0).all(1).float().mean() > 0.9
    obj = quiet(td.clone())["obj"]
    assert not obj[~person].any()
    assert torch.equal(obj[person], drifted[person])
    one = torch.stack([quiet(each)["obj"] for each in td])
    assert torch.equal(obj, one)
    with pytest.raises(ValueError, match="noise_scales"):
        T.FlowFactorize(K, outputs=["ego"], noise_scales=3.0)


@pytest.mark.parametrize("cast", [lambda t: t.to(torch.bfloat16), lambda t: t.half()])
@pytest.mark.parametrize("given", [torch.float32, torch.float64])
def test_k_keeps_its_type_whatever_the_transform_is_cast_to(cast, given):
    # In bfloat16 a principal point at 319.5 would be at 320.
    K = torch.tensor([[517.3, 0.0, 319.5], [0.0, 516.5, 255.3], [0.0, 0.0, 1.0]], dtype=given)
    keys = {"in_keys": ("sensor", "depth"), "out_keys": "z"}
    adapt = T.AdaptDepth("ray_length", intrinsics=K, **keys)
    for transform in (T.RawFlow(K), T.FlowFactorize(K), adapt):
        cast(transform)
        assert transform.K.dtype == given
        assert torch.equal(transform.K, K)
        assert not transform.state_dict()
        assert transform.to("meta").K.is_meta  # devices it follows


class ZoomingEnv(FakeSensorEnv):
    """Has a focal length that grows by 3 % a step; from episode to episode K differs, too."""

    def _observe(self):
        seen = super()._observe()
        steps, episodes = (
            torch.tensor(x).reshape(self.batch_size) for x in (self.steps, self.episodes)
        )
        seen["sensor", "K"][..., 0, 0] *= 1.03**steps + 0.1 * episodes
        return seen


CAMERA = {"intrinsics": ("sensor", "K"), "prev_intrinsics": ("sensor", "prev_K")}


def test_a_camera_that_zooms_has_the_flow_of_both_its_cameras_online_and_in_replay():
    raw, split = T.RawFlow(**CAMERA), T.FlowFactorize(**CAMERA)
    stack = Compose(
        T.PreviousIntrinsics(),
        raw,
        T.EstimateCameraMotion(**CAMERA, outputs=["motion"], out_keys=["motion"]),
        split,
        T.FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=["rgb2"]),
        T.EstimatedFlow(lambda a, b: torch.zeros(len(a), 2, 5, 7), **CAMERA, out_keys="own"),
    )
    env = TransformedEnv(ZoomingEnv((2,)), stack)
    check_env_specs(env, seed=None)
    frames = env.rollout(6, break_when_any_done=False)["next"].reshape(-1)
    for one in frames:
        depth, ids, motions, K, prev_K = (
            one["sensor", key] for key in ("depth", "instance", "instance_motion", "K", "prev_K")
        )
        want = flow_pixel_by_pixel(depth, K, motions, prev_K, ids).float()
        torch.testing.assert_close(one["raw"], want, atol=1e-4, rtol=0)
    motion = frames["sensor", "prev_from_curr"]
    torch.testing.assert_close(frames["motion"], motion, atol=1e-4, rtol=0)
    # nothing moved in the warped picture: flow is ego flow, wherever that is known
    known = (frames["sensor", "depth"] > 0).expand_as(frames["ego"])
    torch.testing.assert_close(frames["own"][known], frames["ego"][known])
    alone = frames.select("sensor")[torch.randperm(len(frames))]  # shuffled, without a next frame
    for each in (frames, split(raw(alone))):
        stands = each["sensor", "instance"] != WALKER
        assert not each["obj"][stands.expand_as(each["obj"])].any()


@pytest.mark.parametrize(
    "make",
    [
        *(T.RawFlow, T.EstimateCameraMotion, partial(T.FlowFactorize, outputs=["ego"])),
        partial(T.EstimatedFlow, brightening),
        lambda **camera: T.representation_stack(["ego"], **camera)[0],
    ],
)
def test_k_under_a_key_is_refused_without_prev_intrinsics(make):
    key = ("sensor", "K")
    with pytest.raises(ValueError, match=r"'K'\).*prev_intrinsics=.*PreviousIntrinsics"):
        make(intrinsics=key)
    never_changes = make(intrinsics=key, prev_intrinsics=key)
    assert [each for each in never_changes.in_keys if each == key] == [key]


SIZE = torch.tensor([[7.0], [5.0], [1.0]])
WRONG_CAMERAS = {  # of maps 7 wide and 5 high
    "transposed": lambda K: K.mT,
    "normalised by the size": lambda K: K / SIZE,
    "twice": lambda K: 2 * K,
    "of a picture of twice the size": lambda K: K * torch.tensor([[2.0], [2.0], [1.0]]),
    "cx = cy = 0": lambda K: K * torch.eye(3),
    "a focal length of 25 widths": lambda K: K * torch.tensor([[30.0, 1, 1], [1] * 3, [1] * 3]),
    "fy < 0": lambda K: K * torch.tensor([[1.0] * 3, [1, -1, 1], [1] * 3]),
}


@pytest.mark.parametrize("spoil", WRONG_CAMERAS.values(), ids=list(WRONG_CAMERAS))
@pytest.mark.parametrize(
    "make",
    [T.RawFlow, T.FlowFactorize, T.EstimateCameraMotion, partial(T.AdaptDepth, "ray_length")],
)
def test_a_k_that_no_camera_of_the_maps_has_is_refused_by_both_roads(make, spoil):
    batch = moments(3)
    batch["depth"] = batch["sensor", "depth"]
    copied = RenameTransform([("sensor", "depth")], ["depth"], create_copy=True)
    env = TransformedEnv(FakeSensorEnv((3,)), Compose(T.RawFlow(INTRINSICS), copied))
    with pytest.raises(ValueError, match=r"^intrinsics "):
        env.append_transform(make(intrinsics=spoil(torch.tensor(INTRINSICS)))).rollout(1)
    with pytest.raises(ValueError, match=r"^intrinsics "):
        make(intrinsics=spoil(torch.tensor(INTRINSICS)))(batch.clone())
    key = ("sensor", "K")
    options = {} if make.__class__ is partial else {"prev_intrinsics": key}
    by_key = make(intrinsics=key, **options)
    by_key(batch.clone())
    batch["sensor", "K"][1] = spoil(batch["sensor", "K"][1].clone())
    with pytest.raises(ValueError, match=r"^key \('sensor', 'K'\)\[1\] "):
        by_key(batch)


@pytest.mark.parametrize("unknown", [math.nan, math.inf, 0.0])
def test_a_k_under_a_key_that_is_not_known_makes_its_frame_alone_invalid(unknown):
    with pytest.raises(ValueError, match=r"^intrinsics should have the rows \(fx.* got \[\["):
        T.RawFlow(unknown * torch.tensor(INTRINSICS))
    td = moments(3).exclude("raw")
    td["sensor", "prev_K"] = td["sensor", "K"].clone()
    stack = Compose(
        T.RawFlow(**CAMERA),
        T.FlowFactorize(**CAMERA),
        T.EstimateCameraMotion(**CAMERA, out_keys=list("abcd")),
    )
    good = stack(td.clone())
    for key in ("K", "prev_K"):
        spoilt = td.clone()
        spoilt["sensor", key][1] *= unknown
        spoilt = stack(spoilt)
        assert not spoilt["raw_valid"][1].any()
        assert spoilt["obj"][1].abs().max() == 0
        assert spoilt["d"].flatten().tolist() == [True, False, True]
        for name in ("raw", "ego", "obj", "raw_valid", "a"):
            assert torch.equal(spoilt[name][::2], good[name][::2])


@pytest.mark.parametrize("share", [0.11, 0.89])
def test_crops_and_telephoto_and_wide_lenses_are_cameras(share):
    # A crop that lost up to four ninths of the picture on one side; lenses of 2.9 and 136 degrees.
    for focal in (1.5, 139.0):
        K = torch.tensor([[focal, 0.5, 7 * share], [0.0, focal, 5 * share], [0.0, 0.0, 1.0]])
        frames = TransformedEnv(FakeSensorEnv(), T.RawFlow(K)).rollout(2)["next"]
        assert frames["raw_valid"].flatten(-2).any(-1).all()
