"""A checkpoint belongs to its run's config and version; the machine is noted."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from flowrep.agent import CheckpointError
from flowrep.experiment.provenance import check_origin, machine_of, origin_of
from tests.config.composing import plain

PATH = Path("run/checkpoint/latest.safetensors")


@pytest.fixture(scope="module")
def config():
    return plain("train", "debug=smoke")


def test_the_same_run_on_another_machine_is_the_same(config):
    here = config | {"device": "cuda", "num_workers": 7, "resume": "somewhere"}
    check_origin(origin_of(config), origin_of(here), PATH)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        ("scene.camera.fov_deg", 90.0, r"scene.camera.fov_deg=60.0, the config.yaml .*=90.0"),
        ("scene.name", "s_turn", "scene.name=straight_road, "),
        ("representations.ego.scale", 0.3, "representations.ego.scale=.* says .*=0.3"),
        ("representations.seg", {}, "representations.seg=absent"),
        ("motion", "estimated", "motion=exact, .* says motion=estimated"),
        ("noise.drift_m", 0.1, "noise.drift_m=0.0, .* says noise.drift_m=0.1"),
    ],
)
def test_an_edited_config_is_refused_by_the_name_of_the_key(config, place, value, says):
    edited = OmegaConf.create(config)
    OmegaConf.update(edited, place, value)
    with pytest.raises(CheckpointError, match=f"{PATH} belongs to a run with {says}"):
        check_origin(origin_of(config), origin_of(OmegaConf.to_container(edited)), PATH)


def test_another_version_is_refused(config):
    with pytest.raises(CheckpointError, match=r"0\.0\.9"):
        check_origin(origin_of(config) | {"flowrep": "0.0.9"}, origin_of(config), PATH)


def test_a_clone_on_a_machine_without_git_has_no_commit(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert machine_of("fp32")["commit"] is None
