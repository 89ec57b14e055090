"""representation_stack: names to transforms, each thing computed once."""

import functools

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs

from flowrep import geometry
from flowrep.transforms import REPRESENTATIONS, representation_stack
from flowrep.transforms.base import MissingKey
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, FakeSensorEnv, moments
from tests.transforms.test_motion import WIDE, wide_frames

stack = functools.partial(representation_stack, intrinsics=INTRINSICS, num_classes=NUM_CLASSES)


def rollout(representations, **options) -> torch.Tensor:
    return TransformedEnv(FakeSensorEnv((2,)), stack(representations, **options)).rollout(5)


@pytest.mark.parametrize(
    ("representations", "expected"),
    [
        (["ego"], "FlowFactorize"),
        (["raw"], "RawFlow DropKeys"),
        (["obj"], "RawFlow"),
        (["obj", "ego", "raw"], "RawFlow DropKeys"),
        (["ego", "raw"], "RawFlow DropKeys"),
        (["seg", "seg2", "depth"], "Segmentation Depth FrameStack"),
        (["depth2", "seg2"], "Depth Segmentation FrameStack FrameStack DropKeys"),
        (["rgb"], "Rgb"),
    ],
)
def test_a_stack_has_no_transform_twice(representations, expected):
    assert [type(each).__name__ for each in stack(representations)] == expected.split()


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_each_representation_writes_its_own_key_and_no_other(name):
    env = TransformedEnv(FakeSensorEnv((2,)), stack([name]))
    check_env_specs(env)
    assert set(env.observation_spec.keys()) == {"sensor", name}
    td = env.rollout(2)
    assert set(td["next"].keys()) - {"done", "terminated", "reward"} == {"sensor", name}
    offline = stack([name])(FakeSensorEnv((2,)).rollout(2))
    assert set(offline.keys()) - {"done", "terminated", "action", "next"} == {"sensor", name}
    assert set(offline["next"].keys()) == set(td["next"].keys())


def test_a_stack_of_all_representations_equals_each_alone():
    together = rollout(REPRESENTATIONS)
    for name in REPRESENTATIONS:
        assert torch.equal(together[name], rollout([name])[name])


def test_options_reach_the_transforms():
    flows = {"raw": {"scale": 2.0}, "ego": {"scale": 4.0}, "obj": None}
    depths = {"depth": {"range_m": 20.0}, "depth2": {"k": 3}}
    td = rollout({**flows, **depths, "seg": {"encoding": "onehot"}, "seg2": {}})
    plain = rollout(["raw", "ego", "obj", "depth", "seg", "seg2"])
    assert torch.equal(td["raw"], 2 * plain["raw"])
    assert torch.equal(td["ego"], 4 * plain["ego"])
    assert torch.equal(td["obj"], plain["obj"])
    assert torch.allclose(td["depth"], (5 * plain["depth"]).clamp(max=1))
    assert td["depth2"].shape[-3] == 3
    assert torch.equal(td["depth2"][..., 2:, :, :], plain["depth"])  # its own range, not depth's
    assert td["seg"].shape[-3] == NUM_CLASSES
    assert torch.equal(td["seg2"], plain["seg2"])


def test_flow_of_a_time_is_a_share_of_a_steps():
    # A step takes 1/6 s, twice the twelfth of a second: flow is half as long.
    asked = {"ego": {"rate_hz": 12}, "raw": {"rate_hz": 12.0, "scale": 3.0}, "obj": None}
    td = rollout(asked, frame_rate_hz=6.0)
    plain = rollout(["ego", "raw", "obj"])
    assert plain["ego"].abs().max() > 0
    assert torch.allclose(td["ego"], plain["ego"] / 2)
    assert torch.allclose(td["raw"], 3 * plain["raw"] / 2)
    assert torch.equal(td["obj"], plain["obj"])


NOISE = {"depth_sigma_per_m": 0.01, "depth_dropout": 0.2, "drift_m": 0.05, "drift_rad": 0.01}


def framed(count: int = 6) -> TensorDict:
    """A trajectory of the fake env's frames with names, as a street gives them."""
    td = moments(count).exclude("raw").refine_names("time")
    td["next", "done"] = torch.zeros(count, 1, dtype=torch.bool)
    td["sensor", "frame"] = torch.stack([torch.arange(count) + 40, torch.arange(count)], -1)
    return td


def test_noise_is_in_what_depth_and_odometry_go_into_and_in_nothing_else():
    exact, noisy = (stack(list(REPRESENTATIONS), noise=n)(framed()) for n in (None, NOISE))
    changed = {name for name in REPRESENTATIONS if not torch.equal(exact[name], noisy[name])}
    assert changed == {"depth", "depth2", "ego", "obj"}
    given = framed()["sensor"]
    for key in sorted(given.keys()):
        assert torch.equal(noisy["sensor", key].nan_to_num(), given[key].nan_to_num()), key
    # All four see the same errors: holes are holes in each, and raw is known there all the same.
    hole = noisy["sensor", "noisy_depth"].isnan()
    assert 0.1 < hole.float().mean() < 0.4
    assert (noisy["depth"][hole] == 0).all()
    assert (noisy["ego"][hole.expand(-1, 2, -1, -1)] == 0).all()
    want = geometry.ego_flow(
        noisy["sensor", "noisy_depth"], torch.tensor(INTRINSICS), noisy["sensor", "noisy_motion"]
    )
    assert torch.equal(noisy["ego"], want.flow)
    known = want.valid.expand(-1, 2, -1, -1)
    assert torch.equal(noisy["obj"][known], (noisy["raw"] - noisy["ego"])[known])


@pytest.mark.parametrize(
    ("names", "noise", "read"),
    [
        (["ego", "obj", "raw", "depth2"], dict.fromkeys(NOISE, 0.0), None),
        (["raw", "seg", "rgb"], NOISE, None),
        (["depth2"], {"drift_m": 0.1}, None),
        (["depth2"], NOISE, ["depth", "frame"]),
        (["ego"], {"drift_rad": 0.1}, ["prev_from_curr", "frame"]),
        (["obj", "depth"], NOISE, ["depth", "prev_from_curr", "frame"]),
    ],
)
def test_noise_is_drawn_only_for_sensors_that_are_read_and_noisy(names, noise, read):
    first = stack(names, noise=noise)[0]
    if read is None:
        assert repr(stack(names, noise=noise)) == repr(stack(names))
    else:
        assert first.in_keys == [("sensor", name) for name in read]


def test_a_missing_sensor_is_reported_under_the_name_that_was_asked_for():
    with pytest.raises(MissingKey, match=r"'obj' needs key \('sensor', 'instance'\)"):
        stack(["obj"])(moments(2).exclude(("sensor", "instance")))
    with pytest.raises(MissingKey, match=r"depth2 and obj needs key \('sensor', 'frame'\)"):
        stack(["depth2", "obj"], noise=NOISE)(moments(2))


@pytest.mark.parametrize("flow", ["exact", "estimated"])
def test_estimated_motion_takes_the_place_of_the_env_s(flow):
    build = functools.partial(representation_stack, intrinsics=WIDE, flow=flow, motion="estimated")
    td = wide_frames(2)  # without prev_from_curr
    if flow == "estimated":
        texture = 255 * torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(1))
        td["sensor", "rgb"] = texture.to(torch.uint8)
        td["_rgb2"] = torch.cat([td["sensor", "rgb"]] * 2, 1)  # a picture that stayed the same
    made = build(["ego"])(td.clone())
    motion = torch.eye(4).expand(2, 4, 4) if flow == "estimated" else td["truth"]
    torch.testing.assert_close(made["sensor", "estimated_motion"], motion, rtol=0, atol=1e-4)
    ego = geometry.ego_flow(td["sensor", "depth"], torch.tensor(WIDE), motion).flow
    torch.testing.assert_close(made["ego"], ego, rtol=0, atol=1e-3)
    together = build(["raw", "ego", "obj"])(td.clone())
    assert torch.equal(together["ego"], made["ego"])
    assert torch.equal(together["obj"], together["raw"] - together["ego"])
    left = {"truth", "sensor", "raw", "ego", "obj"} | ({"_rgb2"} if flow == "estimated" else set())
    assert set(together.keys()) == left


def test_estimated_motion_reads_noisy_depth_and_no_odometry():
    build = functools.partial(stack, noise=NOISE, motion="estimated")
    read = {key for transform in build(["ego"]) for key in transform.in_keys}
    assert ("sensor", "prev_from_curr") not in read
    assert ("sensor", "noisy_depth") in build(["ego"])[-2].in_keys
    assert stack(["raw"], motion="estimated")[0].out_keys == ["raw", "raw_valid"]
