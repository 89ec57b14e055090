"""representation_stack: names to transforms, each thing computed once."""

from __future__ import annotations

import collections
import functools

import pytest
import torch
from torchrl.envs import TransformedEnv, check_env_specs

from flowrep import geometry
from flowrep.transforms import (
    REPRESENTATIONS,
    Depth,
    Segmentation,
    representation_options,
    representation_stack,
)
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, FakeSensorEnv

stack = functools.partial(
    representation_stack, intrinsics=INTRINSICS, num_classes=NUM_CLASSES, dt_s=0.5
)


def rollout(representations) -> torch.Tensor:
    return TransformedEnv(FakeSensorEnv((2,)), stack(representations)).rollout(5)


@pytest.fixture
def calls(monkeypatch):
    """Counts what is computed in one step of an env."""
    counter: collections.Counter[str] = collections.Counter()

    def count(owner, name):
        function = getattr(owner, name)

        @functools.wraps(function)
        def counted(*args, **kwargs):
            counter[f"{owner.__name__.rpartition('.')[2]}.{name}"] += 1
            return function(*args, **kwargs)

        monkeypatch.setattr(owner, name, counted)

    for name in ("ego_flow", "rigid_flow", "factorize"):
        count(geometry, name)
    count(Segmentation, "compute")
    count(Depth, "compute")
    return counter


@pytest.mark.parametrize(
    ("representations", "expected"),
    [
        (["ego"], {"geometry.ego_flow": 1}),
        (["raw"], {"geometry.rigid_flow": 1}),
        (["obj"], {"geometry.rigid_flow": 1, "geometry.factorize": 1}),
        (["ego", "obj"], {"geometry.rigid_flow": 1, "geometry.factorize": 1}),
        (["obj", "ego", "raw"], {"geometry.rigid_flow": 1, "geometry.factorize": 1}),
        (["ego", "raw"], {"geometry.rigid_flow": 1, "geometry.ego_flow": 1}),
        (["seg", "seg2", "depth"], {"Segmentation.compute": 1, "Depth.compute": 1}),
        (["depth2", "seg2"], {"Segmentation.compute": 1, "Depth.compute": 1}),
        (["rgb"], {}),
    ],
)
def test_each_thing_is_computed_once(calls, representations, expected):
    env = TransformedEnv(FakeSensorEnv((2,)), stack(representations))
    td = env.reset().set("action", torch.zeros(2, dtype=torch.long))
    calls.clear()
    env.step(td)
    assert dict(calls) == expected


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


def test_all_at_once_are_what_each_is_alone():
    together = rollout(REPRESENTATIONS)
    for name in REPRESENTATIONS:
        assert torch.equal(together[name], rollout([name])[name])


def test_options_reach_the_transforms():
    td = rollout(
        {
            "raw": {"scale": 2.0},
            "ego": {"unit": "px_per_s"},
            "obj": None,
            "depth": {"range_m": 20.0},
            "depth2": {"k": 3},
            "seg": {"encoding": "onehot"},
            "seg2": {},
        }
    )
    plain = rollout(["raw", "ego", "obj", "depth", "seg", "seg2"])
    assert torch.equal(td["raw"], 2 * plain["raw"])
    assert torch.equal(td["ego"], 2 * plain["ego"])  # 0.5 s a step
    assert torch.equal(td["obj"], plain["obj"])
    assert torch.allclose(td["depth"], (5 * plain["depth"]).clamp(max=1))
    assert td["depth2"].shape[-3] == 3
    assert torch.equal(td["depth2"][..., 2:, :, :], plain["depth"])  # its own range, not depth's
    assert td["seg"].shape[-3] == NUM_CLASSES
    assert torch.equal(td["seg2"], plain["seg2"])


def test_options_of_raw_alone():
    td = rollout({"raw": {"scale": 2.0, "unit": "px_per_s"}})
    assert torch.equal(td["raw"], 4 * rollout(["raw"])["raw"])


def test_one_representation_s_options():
    assert representation_options("seg2") == {"k": 2, "encoding": "ids"}
    assert representation_options("obj") == {"scale": 1.0, "unit": "px_per_step"}
    assert representation_options("rgb") == {}


@pytest.mark.parametrize(
    ("representations", "expected"),
    [
        (["eggo"], r"'eggo', did you mean 'ego'\?.*'depth2'"),
        (["lidar"], r"unknown representation 'lidar'\. There are \["),
        (["ego", "obj", "ego"], "'ego' is named 2 times"),
        ({"depth": {"rangem": 3}}, r"'depth': 'rangem', did you mean 'range_m'\?.*'missing'"),
        ({"obj": {"k": 3}}, "option of representation 'obj': 'k'"),
        ({"seg": "onehot"}, "options of representation 'seg' are a mapping.*'onehot'"),
        ("ego", r"a list of names, e\.g\. \['ego'\]"),
        ([], "no representation is named"),
    ],
)
def test_mistakes_are_explained(representations, expected):
    with pytest.raises(ValueError, match=expected):
        stack(representations)


def test_an_unknown_name_has_no_options():
    with pytest.raises(ValueError, match=r"'dept', did you mean 'depth'\?"):
        representation_options("dept")


def test_what_the_camera_has_to_say_is_asked_for():
    for segmentation in ("seg", "seg2"):
        with pytest.raises(ValueError, match="need num_classes="):
            representation_stack([segmentation])
    with pytest.raises(ValueError, match="need intrinsics="):
        representation_stack(["depth", "ego"], num_classes=3)
    with pytest.raises(ValueError, match="needs dt_s"):
        representation_stack({"ego": {"unit": "px_per_s"}}, intrinsics=INTRINSICS)
    assert representation_stack(["depth", "rgb"])


def test_a_missing_sensor_is_reported_under_the_name_that_was_asked_for():
    class NoInstances(FakeSensorEnv):
        def __init__(self) -> None:
            super().__init__()
            del self.observation_spec["sensor", "instance"]

    env = TransformedEnv(NoInstances(), stack(["obj"]))
    with pytest.raises(KeyError, match=r"'obj' needs key \('sensor', 'instance'\)"):
        env.observation_spec  # noqa: B018
