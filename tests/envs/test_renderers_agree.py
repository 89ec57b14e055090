"""The rasteriser and PyBullet see the same street."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrep.palette import CATEGORY_ID
from flowrep.scenes import load_scene, scene_names

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "rasterise.py"
CROSSROADS = Path(__file__).parents[1] / "scenes" / "crossroads.yaml"


@pytest.fixture(scope="module")
def Pair():
    spec = importlib.util.spec_from_file_location("rasterise", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Pair


def assert_agree(pair, count):
    """Compares so many views; returns the classes that were seen."""
    found = [pair.difference() for _ in pair.views(count)]
    camera = pair.scene.camera
    pair.close()
    pixels = count * camera.height_px * camera.width_px
    assert sum(view.ids for view in found) <= 1e-3 * pixels
    assert not any(view.inside for view in found)
    assert np.median([view.depth for view in found]) <= 1e-5
    return set.union(*(view.seen for view in found))


@pytest.mark.slow_after_first
@pytest.mark.parametrize("scene", [*scene_names(), CROSSROADS], ids=lambda name: Path(name).stem)
def test_views_of_a_scene(Pair, scene):
    seen = assert_agree(Pair(scene), 40)
    assert seen == {CATEGORY_ID[name] for name in load_scene(scene).categories}


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", ["straight_road", "three_way_junction"])
def test_views_between_near_and_far_planes_that_cut_through_everything(Pair, name):
    scene = load_scene(name)
    # H != W; people are cut open at 1.5 m, houses and trees end at 30 m.
    camera = replace(scene.camera, height_px=50, width_px=70, near_m=1.5, far_m=30.0, pitch_deg=20)
    seen = assert_agree(Pair(replace(scene, camera=camera)), 30)
    assert {CATEGORY_ID["sky"], CATEGORY_ID["pedestrian"]} <= seen


def test_maps_do_not_depend_on_whether_colours_are_asked_for(make_street):
    alone, with_colours = (
        make_street("three_way_junction", sensors=sensors)
        for sensors in (("depth", "instance"), ("depth", "instance", "rgb"))
    )
    for env in (alone, with_colours):
        env.reset(seed=4)
    a, b = (env.step(1)[0] for env in (alone, with_colours))
    for name in ("depth", "instance"):
        np.testing.assert_array_equal(a[name], b[name])
