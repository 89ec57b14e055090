"""`check_flow` on drives in a street: right data are right, each wrong convention is named."""

import pytest
import torch

from flowrep import geometry
from flowrep.testing import check_flow

pytest.importorskip("pybullet", reason="the frames are of a simulated street")


@pytest.fixture(scope="module")
def drive():
    """Returns K and 20 frames of a drive that turns among people who walk."""
    from flowrep.envs import make_env

    env = make_env("s_turn", ["raw"], seed=3, keep_sensor=True)
    K = torch.from_numpy(env.base_env._env.envs[0].unwrapped.K).float()
    env.reset()
    frames = env.rollout(20, policy=lambda td: td.set("action", torch.tensor([1])))["next"]
    env.close()
    return K, frames


def spoilt(frames, K, **changes):
    """Returns the frames with another depth, K or motions, and the raw flow that follows."""
    frames = frames.clone()
    for key, value in changes.items():
        frames["sensor", key] = value
    sensor = frames["sensor"]
    frames["raw"] = geometry.rigid_flow(
        sensor["depth"], sensor["instance"], K, sensor["instance_motion"]
    ).flow
    return frames


def test_flow_of_the_street_is_right_and_beats_every_rival(drive):
    K, frames = drive
    found = check_flow(frames, K)
    assert found.is_right
    assert found.agreement > 0.99
    assert max(found.flows["no flow"], found.flows["-raw"]) < 0.9
    assert str(found).endswith("right")


def ray_length(depth, K):
    v, u = torch.meshgrid(torch.arange(84) + 0.5, torch.arange(84) + 0.5, indexing="ij")
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones(84, 84)])
    return depth * rays.norm(dim=0)


@pytest.mark.parametrize(
    ("key", "change", "says"),
    [
        ("depth", ray_length, "ray"),
        ("instance_motion", lambda motions, K: geometry.invert_rigid(motions), "curr_from_prev"),
        # a still camera
        ("instance_motion", lambda motions, K: torch.eye(4).expand_as(motions), "can't tell"),
    ],
)
def test_a_wrong_convention_is_named(drive, key, change, says):
    K, frames = drive
    found = check_flow(spoilt(frames, K, **{key: change(frames["sensor", key], K)}), K)
    assert not found.is_right
    assert says in str(found).splitlines()[-1]


def test_a_camera_of_twice_the_size_is_named(drive):
    K, frames = drive
    double = torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ K
    found = check_flow(spoilt(frames, double), double)
    assert not found.is_right
    assert "twice" in str(found).splitlines()[-1]


def test_a_single_frame_is_refused(drive):
    K, frames = drive
    with pytest.raises(ValueError, match="successive"):
        check_flow(frames[:, :1], K)
