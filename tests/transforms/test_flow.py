"""Flow transforms: hand-worked values, units, masks, what stands still."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import Compose

from flowrep.transforms import AdaptDepth, FlowFactorize, RawFlow, representation_stack
from tests.transforms.fake_env import INTRINSICS, STATUE, WALKER, FakeSensorEnv, frame

# fx = 40, fy = 20, cx = 2, cy = 1: pixel (column 1, row 0) sits at x~ = -0.5, y~ = -0.5.
K = [[40.0, 0.0, 2.0], [0.0, 20.0, 1.0], [0.0, 0.0, 1.0]]


def scene() -> TensorDict:
    """Returns a 2 x 4 view at 8 m; the camera slid 0.4 m right, a body at (1, 0) rose 0.8 m."""
    camera = torch.eye(4)
    camera[0, 3] = 0.4  # what is at x now was at x + 0.4 before
    motions = camera.repeat(3, 1, 1)
    motions[1, 1, 3] = 0.8  # y points down: the body was 0.8 m lower
    instance = torch.zeros(1, 2, 4, dtype=torch.uint8)
    instance[0, 0, 1] = 1
    sensor = {
        "depth": torch.full((1, 2, 4), 8.0),
        "instance": instance,
        "prev_from_curr": camera,
        "instance_motion": motions,
    }
    return TensorDict({"sensor": sensor})


def factors(td: TensorDict, **options) -> TensorDict:
    return FlowFactorize(K, **options)(RawFlow(K)(td))


def test_a_camera_that_slides_right_sees_the_world_go_left_and_a_body_that_rose_go_up():
    td = factors(scene())
    # fx * 0.4 m / 8 m = 2 px to the left, fy * 0.8 m / 8 m = 2 px up (v points down).
    # p_t' - p_t, the rival convention, would be +2 and +2; swapped fx and fy -1 and -4.
    assert torch.allclose(td["raw"][:, 0, 1], torch.tensor([-2.0, -2.0]))
    assert torch.allclose(td["ego"][:, 0, 1], torch.tensor([-2.0, 0.0]))
    assert torch.allclose(td["obj"][:, 0, 1], torch.tensor([0.0, -2.0]))
    assert torch.allclose(td["raw"][:, 1, 3], torch.tensor([-2.0, 0.0]))


def test_units_and_scales_are_each_output_s_own():
    td = factors(
        scene(),
        outputs=["raw", "ego", "obj"],
        out_keys=["raw_out", "ego", "obj"],
        scale={"raw": 1.0, "ego": 0.5, "obj": 3.0},
        unit={"raw": "px_per_s", "ego": "px_per_step", "obj": "px_per_s"},
        dt_s=0.25,
    )
    assert torch.allclose(td["raw_out"][:, 0, 1], torch.tensor([-8.0, -8.0]))  # -2 px / 0.25 s
    assert torch.allclose(td["ego"][:, 0, 1], torch.tensor([-1.0, 0.0]))
    assert torch.allclose(td["obj"][:, 0, 1], torch.tensor([0.0, -24.0]))
    raw = RawFlow(K, unit="px_per_s", dt_s=0.25, scale=0.5)(scene())["raw"]
    assert torch.allclose(raw[:, 0, 1], torch.tensor([-4.0, -4.0]))


@pytest.mark.parametrize("options", [{}, {"scale": 3.7, "unit": "px_per_s", "dt_s": 1 / 12}])
def test_object_flow_is_exactly_0_on_what_stands_still(options):
    td = TensorDict({"sensor": frame(env=1, episode=0, step=2)})
    split = FlowFactorize(INTRINSICS, **options)(RawFlow(INTRINSICS)(td))
    moves = (td["sensor", "instance"] == WALKER).expand(2, -1, -1)
    assert (split["obj"][~moves] == 0).all()  # the statue's pixels among them
    assert (td["sensor", "instance"] == STATUE).any()
    hole = td["sensor", "depth"].isnan().expand(2, -1, -1)
    assert (split["obj"][moves & ~hole] != 0).all()


@pytest.mark.parametrize("precision", [torch.float16, torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("other", [torch.float32, torch.float64], ids=str)
def test_whatever_the_float_types_raw_and_ego_round_alike(precision, other):
    td = TensorDict({"sensor": frame(env=1, episode=0, step=2)})
    for key, dtype in (("depth", precision), ("prev_from_curr", other), ("instance_motion", other)):
        td["sensor", key] = td["sensor", key].to(dtype)
    intrinsics = torch.tensor(INTRINSICS, dtype=other)
    intrinsics[0, 0] = 6.1  # not the same number in float32 and float64
    for stack in (
        Compose(RawFlow(intrinsics), FlowFactorize(intrinsics)),
        representation_stack(["obj"], intrinsics=intrinsics),
    ):
        obj = stack(td.clone())["obj"]
        still = (td["sensor", "instance"] != WALKER).expand(2, -1, -1)
        assert (obj[still] == 0).all()
        assert obj.dtype == torch.promote_types(precision, torch.float32)


def test_still_camera_leaves_everything_to_the_objects():
    td = scene()
    td["sensor", "prev_from_curr"] = torch.eye(4)
    td["sensor", "instance_motion"][0] = torch.eye(4)
    td = factors(td)
    assert (td["ego"] == 0).all()
    assert torch.equal(td["obj"], td["raw"])


def test_nothing_flows_at_a_reset():
    td = FakeSensorEnv((2,)).reset()
    td = FlowFactorize(INTRINSICS)(RawFlow(INTRINSICS)(td))
    assert not any(td[key].any() for key in ("raw", "ego", "obj"))


def test_holes_and_unknown_raw_flow_are_0_and_marked():
    td = RawFlow(K, invalid=math.nan)(scene())
    td["sensor", "depth"][0, 1, 0] = math.nan
    td["raw"][1, 0, 1] = math.nan
    outputs = ["ego", "obj", "raw", "valid"]
    td = FlowFactorize(K, outputs=outputs, out_keys=["ego", "obj", "raw_out", "valid"])(td)
    unknown = torch.zeros(1, 2, 4, dtype=torch.bool)
    unknown[0, 1, 0] = unknown[0, 0, 1] = True
    assert torch.equal(~td["valid"], unknown)
    assert (td["obj"][:, unknown[0]] == 0).all()
    assert (td["ego"][:, 1, 0] == 0).all()
    assert td["ego"][0, 0, 1] == -2.0  # the camera's share is known without raw flow
    assert td["raw_out"][1, 0, 1] == 0.0


def test_a_body_that_came_from_behind_the_camera_has_no_flow():
    td = scene()
    td["sensor", "instance_motion"][1, 2, 3] = -9.0  # it was at z = 8 - 9 < 0
    transform = RawFlow(K, outputs=["raw", "valid"])
    td = transform(td)
    assert not td["valid"][0, 0, 1]
    assert (td["raw"][:, 0, 1] == 0).all()
    assert RawFlow(K, invalid=math.nan)(td)["raw"][:, 0, 1].isnan().all()


def test_a_stack_gives_such_a_body_no_object_flow_either():
    td = scene()
    td["sensor", "instance_motion"][1, 2, 3] = -9.0
    td = representation_stack(["raw", "ego", "obj"], intrinsics=K)(td)
    assert td["ego"][0, 0, 1] == -2.0
    assert (td["raw"][:, 0, 1] == 0).all()
    assert (td["obj"][:, 0, 1] == 0).all()  # raw - ego would be +2


def test_ego_alone_reads_no_raw_flow():
    transform = FlowFactorize(K, outputs=["ego"])
    assert transform.in_keys == [("sensor", "depth"), ("sensor", "prev_from_curr")]
    ego = transform(scene().exclude(("sensor", "instance")))["ego"]
    assert torch.equal(ego, factors(scene())["ego"])


def test_intrinsics_are_copied_and_no_part_of_the_state():
    tensor = torch.tensor(K)
    transform = RawFlow(tensor)
    tensor.zero_()
    assert torch.equal(transform.K, torch.tensor(K))
    assert not transform.state_dict()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"outputs": ["ego", "eggo"]}, r"\['ego', 'obj', 'raw', 'valid'\], each once"),
        ({"outputs": ["ego", "ego"]}, "each once"),
        ({"outputs": []}, "each once"),
        ({"outputs": "ego"}, "must be a list"),
        ({"unit": "m_per_s"}, r"\['px_per_step', 'px_per_s'\], got 'm_per_s'"),
        ({"unit": "px_per_s"}, "needs dt_s"),
        ({"unit": "px_per_s", "dt_s": 0.0}, "needs dt_s"),
        ({"scale": 0.0}, "scale must be a finite number other than 0"),
        ({"scale": math.inf}, "scale must be a finite number other than 0"),
        ({"scale": {"ego": 1.0}}, r"^scale needs one value for each of \['ego', 'obj'\]"),
        ({"intrinsics": torch.eye(4)}, r"K, \[3, 3\], or the key of .*; got \[4, 4\]"),
    ],
)
def test_options_are_checked(options, expected):
    with pytest.raises(ValueError, match=expected):
        FlowFactorize(**{"intrinsics": K, **options})


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [
        (0, 0, math.nan),
        (0, 2, math.inf),
        (0, 0, 0.0),
        (1, 1, -5.0),  # v up
        (1, 0, 0.3),
        (2, 0, 3.2),
        (2, 1, 2.1),
        (2, 2, 2.0),
    ],
)
def test_a_k_that_cannot_be_one_is_refused(row, column, value):
    K = torch.tensor(INTRINSICS)
    RawFlow(K)
    K[row, column] = value
    for make in (RawFlow, FlowFactorize, partial(AdaptDepth, "ray_length")):
        with pytest.raises(ValueError, match=r"^intrinsics should have the rows \(fx.* got \[\["):
            make(intrinsics=K)


def test_a_transposed_k_is_refused():  # it would count as cx = cy = 0
    with pytest.raises(ValueError, match=r"K\.T if it is transposed"):
        RawFlow(torch.tensor(INTRINSICS).T)


def test_raw_flow_offers_no_factors():
    with pytest.raises(ValueError, match=r"\['raw', 'valid'\]"):
        RawFlow(K, outputs=["obj"])


@pytest.mark.parametrize("cast", [lambda t: t.to(torch.bfloat16), lambda t: t.half()])
@pytest.mark.parametrize("given", [torch.float32, torch.float64])
def test_k_keeps_its_type_whatever_the_transform_is_cast_to(cast, given):
    # In bfloat16 a principal point at 319.5 would be at 320.
    K = torch.tensor([[517.3, 0.0, 319.5], [0.0, 516.5, 255.3], [0.0, 0.0, 1.0]], dtype=given)
    keys = {"in_keys": ("sensor", "depth"), "out_keys": "z"}
    for transform in (RawFlow(K), FlowFactorize(K), AdaptDepth("ray_length", intrinsics=K, **keys)):
        cast(transform)
        assert transform.K.dtype == given
        assert torch.equal(transform.K, K)
        assert transform.to("meta").K.is_meta  # devices it follows
