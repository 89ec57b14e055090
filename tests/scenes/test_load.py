"""Scenes from names, files and data; files that can't be read; the schema for editors."""

import json
from pathlib import Path

import pytest
import yaml

from docs import scene_keys
from flowrep.config.yaml_file import CONF_DIR
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.load import scene_data

CROSSROADS = Path(__file__).parent / "crossroads.yaml"


def test_a_scene_is_loaded_by_name_file_mapping_or_scene(data):
    scene = load_scene(CROSSROADS)
    assert scene == load_scene(str(CROSSROADS)) == load_scene(data) == load_scene(scene)
    assert load_scene("straight_road").name == "straight_road"
    assert scene.num_pedestrians == 5
    assert scene.time_limit_s == pytest.approx(12.5)


def test_the_planner_drives_a_scene_of_the_users(drive):
    outcomes = [e.outcome for e in drive("planner", 6, CROSSROADS)]
    assert outcomes.count("success") >= 5


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"name: a\nroads: [1\n", ", line 3: "),
        (b"- a\n- b", ""),
        (b"", ""),
        (CROSSROADS.read_bytes().replace(b"layout_seed", b"layout_sed"), "layout_sed: "),
    ],
)  # fmt: skip
def test_an_invalid_file_is_refused_on_one_line(tmp_path, content, named):
    file = tmp_path / "odd.yaml"
    file.write_bytes(content)
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    assert str(caught.value).startswith(str(file))
    assert named in str(caught.value).removeprefix(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("scene", "named"), [("straight", "straight_road"), ("a.yaml", "a.yaml")])
def test_an_unknown_scene_is_refused(tmp_path, monkeypatch, scene, named):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=named):
        load_scene(scene)


def test_the_name_of_a_scene_is_that_of_its_file(tmp_path):
    file = tmp_path / "alley.yaml"
    file.write_bytes(CROSSROADS.read_bytes())
    with pytest.raises(SceneError, match=r"alley\.yaml: name: .*'alley'"):
        load_scene(file)


def test_merge_keys_and_anchors_of_yaml_may_be_used(tmp_path, data):
    data["building_rows"] = "ROWS"
    rows = """
  - &house {road: stem, side: left, from_m: 0.0, to_m: 10.0, setback_m: 2.0,
            front_m: [7, 9], depth_m: [6, 9], height_m: [5, 9]}
  - {<<: *house, from_m: 20.0, to_m: 38.0}"""
    file = tmp_path / "crossroads.yaml"
    file.write_text(yaml.dump(data).replace("ROWS", rows))
    first, second = load_scene(file).building_rows
    assert (first.to_m, second.to_m, second.front_m) == (10.0, 38.0, (7.0, 9.0))


def test_editors_explain_every_key():
    schema = scene_keys.schema()
    assert json.loads(scene_keys.SCHEMA.read_text("utf-8")) == schema, "make schema"
    for part in (schema, *schema["$defs"].values()):
        assert part["description"]
        for key, field in part["properties"].items():
            assert "description" in field or "$ref" in str(field), key


@pytest.mark.parametrize("file", [*sorted((CONF_DIR / "scene").glob("*.yaml")), CROSSROADS])
def test_scene_data_equals_the_file(file):
    written = yaml.safe_load(yaml.safe_dump(scene_data(load_scene(file))))
    assert written == yaml.safe_load(file.read_text(encoding="utf-8"))
