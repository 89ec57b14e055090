"""Maps of a street built the other way round are the mirror images of the street's maps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from flowrep.envs import StreetEnv, make_mirror
from flowrep.geometry import factorize, rigid_flow
from flowrep.scenes import load_scene, scene_names
from flowrep.simulator.rasteriser import Rasteriser
from flowrep.simulator.street import Street

LEFT, RIGHT = 1, 2
SIDEWAYS = np.diag([1.0, -1.0, 1.0, 1.0])  # of the world and of bodies: y to the left
ACROSS = np.diag([-1.0, 1.0, 1.0, 1.0])  # of the camera: x to the right


def other_way_round(triangles):
    """Returns bodies reflected in their own frames, their triangles seen from outside again."""
    return triangles._replace(
        points=triangles.points * SIDEWAYS.diagonal()[:3],
        centres=triangles.centres * SIDEWAYS.diagonal()[:3],
        corners=triangles.corners[:, ::-1].copy(),
    )


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", scene_names())
def test_maps_of_the_mirrored_street(name):
    scene = load_scene(name)
    camera = replace(scene.camera, height_px=40, width_px=56)
    env = StreetEnv(replace(scene, camera=camera), renderer="rasteriser")
    env.reset(options={"episode_seed": 7})
    for action in [LEFT] * 3 + [RIGHT] * 4 + [LEFT] * 2:
        observation, *_ = env.step(action)
    street = Street.shared(env.scene)
    range_m = camera.near_m, camera.far_m
    size = camera.height_px, camera.width_px
    rasterise = Rasteriser(other_way_round(street.triangles), env.K, size, range_m)
    episode = env.episode
    seen_from, parts, is_shown = env.sensing.views([episode])
    drawn = rasterise(ACROSS @ seen_from @ SIDEWAYS, SIDEWAYS @ parts @ SIDEWAYS, is_shown)
    here = {key: torch.from_numpy(value) for key, value in observation.items()}
    there = {key: torch.from_numpy(value) for key, value in drawn._asdict().items()}
    motion = torch.tensor(ACROSS, dtype=torch.float32)
    there["instance_motion"] = motion @ here["instance_motion"] @ motion
    there["prev_from_curr"] = motion @ here["prev_from_curr"] @ motion
    K = torch.from_numpy(env.K).float()
    td = TensorDict(with_flow(here, K), []).set("action", torch.tensor(LEFT))
    keys = ["depth", "semantic", "instance", "raw", "ego", "obj"]
    mirror = make_mirror(env.scene, keys)
    mirror.images = "all"
    image, want = mirror(td), with_flow(there, K)
    assert (want["obj"] != 0).any()
    assert image["action"] == RIGHT
    for key in keys:
        # equal to the last bit, but for column 0, which shows what the camera didn't see
        assert torch.equal(image[key][..., 1:], want[key][..., 1:])
        # a column further to either side is wrong
        assert not any(
            torch.equal(image[key].roll(step, -1)[..., 2:-1], want[key][..., 2:-1])
            for step in (-1, 1)
        )


def test_a_single_map_is_mirrored_by_its_name():
    assert make_mirror("straight_road", "ego").flow_keys == ["ego"]


def with_flow(frame, K):
    raw = rigid_flow(frame["depth"], frame["instance"], K, frame["instance_motion"]).flow
    ego, obj, _ = factorize(raw, frame["depth"], K, frame["prev_from_curr"])
    return {**frame, "raw": raw, "ego": ego, "obj": obj}
