"""A checkpoint is loaded beside the config that it was made with, and beside no other."""

import copy
from pathlib import Path

import pytest

from flowrep.agent import CheckpointError
from flowrep.experiment.origin import check_origin, origin_of
from tests.test_configs import composed

PATH = Path("run/checkpoint/latest.safetensors")


@pytest.fixture(scope="module")
def config():
    return composed("debug=smoke")


def test_the_same_run_on_another_machine_is_the_same(config):
    here = config | {"device": "cuda", "num_workers": 7, "resume": "somewhere", "wandb": "online"}
    check_origin(origin_of(config), origin_of(here), PATH)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        ("scene.camera.fov_deg", 90.0, r"scene.camera.fov_deg=60.0, the config.yaml .*=90.0"),
        ("scene.name", "s_turn", "scene.name=straight_road, "),
        ("representations.ego.scale", 0.3, "representations.ego.scale=.* says .*=0.3"),
        ("representations.seg", {}, "representations.seg=absent"),
        ("algorithm.gamma", 0.5, "algorithm.gamma=0.99"),
        ("noise.drift_m", 0.1, "noise.drift_m=0.0, .* says noise.drift_m=0.1"),
        ("seed", 1, "seed=0"),
    ],
)
def test_an_edited_config_is_refused_by_the_name_of_the_key(config, place, value, says):
    edited = copy.deepcopy(config)
    *path, key = place.split(".")
    node = edited
    for part in path:
        node = node[part]
    node[key] = value
    with pytest.raises(CheckpointError, match=f"{PATH} belongs to a run with {says}"):
        check_origin(origin_of(config), origin_of(edited), PATH)


def test_another_version_is_refused(config):
    saved = origin_of(config) | {"flowrep": "0.0.9"}
    with pytest.raises(CheckpointError, match=r"by flowrep 0\.0\.9, this is .*: install that"):
        check_origin(saved, origin_of(config), PATH)
