"""Colours of the rasteriser: paint, light and grain on single rectangles, and streets."""

import dataclasses

import numpy as np
import pytest
import torch

from flowrep.geometry import rigid_flow
from flowrep.scenes import scene_names
from flowrep.simulator.meshes import Body, Mesh, gather
from flowrep.simulator.paint import AMBIENT, DIFFUSE, GRAIN_SIZE, LIGHT, PAINTS, grain, swatch
from flowrep.simulator.rasteriser import Rasteriser
from flowrep.transforms.estimated_flow import DIS

ROAD, CAR, PEDESTRIAN = 1, 9, 4
SHIRT = np.array(PAINTS["shirt_red"])


def rectangle(paint, semantic, x, y, z=0.0, *, instance=0):
    """A level rectangle that faces up, of x and y from their first to their second number."""
    mesh = Mesh()
    corners = [(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]
    mesh.quad(np.array(corners), swatch(paint))
    return Body(*mesh.triangles, semantic, instance)


def seen_from_above(*bodies, x=0.0, y=0.0, height_m=2.0, size=(40, 60), focal_px=40.0, poses=()):
    """The picture [H, W, 3] of a camera that looks down; u is along x, v against y."""
    height, width = size
    K = np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
    cam_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    cam_from_world[:3, 3] = -x, y, height_m
    rasterise = Rasteriser(gather(bodies), K, size, (0.1, 1000.0))
    poses = np.array(poses, dtype=float).reshape(1, -1, 4, 4)
    is_shown = np.ones((1, len(bodies)), dtype=bool)
    return rasterise(cam_from_world[None], poses, is_shown, rgb=True).rgb[0].transpose(1, 2, 0)


def test_a_surface_has_its_paint_in_the_light_of_the_sun():
    # Facing straight up: the sun's share is the z of its direction.
    picture = seen_from_above(rectangle("shirt_red", CAR, (-9, 9), (-9, 9)))
    expected = SHIRT * (AMBIENT + DIFFUSE * LIGHT[2])
    # The mean of hardly any contrast; of 3.75 m² not every wave of the grain is seen whole.
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), expected, rtol=0.1)


def test_a_pixel_without_a_surface_is_sky():
    picture = seen_from_above(rectangle("asphalt", ROAD, (0.0, 9.0), (-9.0, 9.0)))
    assert (picture[:, :29] == (112, 178, 232)).all()
    assert (picture[:, 31:] != (112, 178, 232)).any(axis=-1).all()


def test_the_grain_stays_on_the_ground_and_moves_with_people():
    # 40 px of focal length, 2 m above: 0.25 m to the right and 0.1 m ahead are 5 and 2 px.
    road = rectangle("asphalt", ROAD, (-9, 9), (-9, 9))
    before = seen_from_above(road).astype(int)
    assert before.std() > 10
    after = seen_from_above(road, x=0.25, y=0.1).astype(int)
    assert np.abs(after[2:, :-5] - before[:-2, 5:]).max() <= 1
    shirt, pose = rectangle("shirt_red", PEDESTRIAN, (-9, 9), (-9, 9), instance=1), np.eye(4)
    before = seen_from_above(shirt, poses=[pose]).astype(int)
    pose[0, 3] = 0.25
    after = seen_from_above(shirt, poses=[pose]).astype(int)
    assert np.abs(after[:, 5:] - before[:, :-5]).max() <= 1


def test_the_grain_fades_where_a_pixel_covers_it():
    road = rectangle("asphalt", ROAD, (-900, 900), (-900, 900))
    deviations = [seen_from_above(road, height_m=m).std(axis=(0, 1))[0] for m in (4, 40, 400)]
    assert deviations[0] > 15 > deviations[1] > deviations[2]
    assert deviations[2] <= 0.6  # a pixel is 10 m wide, the longest waves 4 m


def test_the_levels_of_the_grain_are_the_same_pattern_ever_coarser():
    fine, below = grain()[:GRAIN_SIZE], grain()[GRAIN_SIZE:]
    next_level = below[: GRAIN_SIZE // 2, : GRAIN_SIZE // 2, 0]
    # The second channel is the next level, which has every second texel of it but no wave shorter
    # than two of its own.
    assert np.abs(next_level - fine[::2, ::2, 1]).max() < 0.2
    assert abs(fine.mean()) < 1e-4
    assert fine[..., 0].std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("scale", [1, 3])
def test_pictures_may_be_larger_than_maps(scale, make_street, straight_road):
    camera = dataclasses.replace(straight_road.camera, height_px=20, width_px=30)
    scene = dataclasses.replace(straight_road, camera=camera)
    env = make_street(scene, sensors=("depth", "rgb"), picture_scale=scale, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["depth"].shape == (1, 20, 30)
    assert observation["rgb"].shape == (3, 20 * scale, 30 * scale)
    np.testing.assert_array_equal(env.render(), observation["rgb"].transpose(1, 2, 0))
    # A block of a larger picture shows what the pixel of the map does: sky above, street below.
    is_sky = (observation["rgb"] == np.array([112, 178, 232])[:, None, None]).all(axis=0)
    blocks = is_sky.reshape(20, scale, 30, scale).mean(axis=(1, 3))
    assert (blocks[np.isinf(observation["depth"][0])]).mean() > 0.9


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", scene_names())
def test_estimated_flow_follows_the_road(name, make_street):
    """Plain asphalt's flow is estimated as 0, which is off by some 6 px."""
    pytest.importorskip("cv2")
    sensors = ("depth", "semantic", "instance", "instance_motion", "rgb")
    env = make_street(name, sensors=sensors)
    K = torch.from_numpy(env.K).float()
    observation, _ = env.reset(options={"episode_seed": 5})
    errors = []
    for _ in range(12):
        previous, observation = observation, env.step(0)[0]
        rgb = torch.from_numpy(np.stack([observation["rgb"], previous["rgb"]]))
        estimated = -DIS()(rgb[:1], rgb[1:])[0]
        now = {key: torch.from_numpy(array) for key, array in observation.items()}
        exact = rigid_flow(now["depth"], now["instance"].long(), K, now["instance_motion"])
        error = (estimated - exact.flow.squeeze()).norm(dim=0)
        errors.append(error[(now["semantic"][0] == ROAD) & exact.valid.squeeze()])
    assert torch.cat(errors).median() < 1.0
