"""Scene files that are no plain data, out of range or too large: one sentence each, at once."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from flowrep.config_tree import CONF_DIR
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.load import json_schema

CROSSROADS = Path(__file__).parent / "crossroads.yaml"
SCHEMA = Path(__file__).parents[2] / "docs" / "scene.schema.json"
ROOT_KEYS = "name, frame_rate_hz, time_limit_steps, categories, layout_seed, camera, vehicle, roads"

BILLION_LAUGHS = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in pairwise("abcdef")
)
MERGES = "a: &a {x: 1, y: 2}\n" + "".join(
    f"{new}: &{new} {{<<: [{', '.join([f'*{old}'] * 20)}]}}\n" for old, new in pairwise("abcde")
)


def message_of(data):
    with pytest.raises(SceneError) as caught:
        load_scene(data)
    return str(caught.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("[" * 3000, "the scene: is nested too deep; fix the file"),
        ("{a: " * 900, "the scene: is nested too deep; fix the file"),
        ("name: 2001-99-99", "the scene: is not YAML: it holds an invalid value (month"),
        ("name: !!int ''", "the scene: is not YAML: it holds an invalid value ("),
        ("name: !!python/object:os.system {}", "the scene: is not YAML: could not determine"),
        ("name: a\nname: b", "the scene: is not YAML: the key 'name' is given twice"),
        ("name: " + "9" * 5000, "the scene: is not YAML: it holds an invalid value (Exceeds"),
        ("a: &a [*a]", "a[0][0][0][0]"),
        (BILLION_LAUGHS, "e[3][3]"),
        (MERGES, "the scene: is not YAML: its merge keys make it too large"),
        ("# " + "x" * 200_000, "the scene: is larger than 100 kB; fix the file"),
        (b"name: \xff\xfe", "the scene: is not text in UTF-8; fix the file"),
        ("- a\n- b", "the scene: expected a mapping, got ['a', 'b']; write a scene's keys"),
        ("", "the scene: expected a mapping, got None; write a scene's keys"),
        ("? null\n: 3", "the scene: has the key None, which is not text; write plain keys and val"),
        ("layout_seed: 2001-01-02", "layout_seed: is a date, not text or a number; write plain"),
        (f"layout_seed: 1{'0' * 40}", "layout_seed: is too large a number; write plain keys"),
        ("nam: a", f"nam: unknown key; the keys are: {ROOT_KEYS}"),
    ],
)  # fmt: skip
def test_files_that_are_no_plain_data_are_refused(tmp_path, content, expected):
    file = tmp_path / "odd.yaml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    message = message_of(file)
    assert message.startswith(f"{file}: {expected}")
    assert "\n" not in message


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("camera.pitch_deg", NAN, "camera.pitch_deg: got nan; it should be at most 90"),
        ("camera.mount_height_m", -INF, "camera.mount_height_m: got -inf; it should be at least"),
        ("camera.width_px", 10**9, "camera.width_px: got 1000000000; it should be at most 4096"),
        ("vehicle.speed_mps", INF, "vehicle.speed_mps: got inf; it should be at most 100"),
        ("frame_rate_hz", 1e-9, "frame_rate_hz: got 1e-09; it should be at least 0.5"),
        ("layout_seed", -1, "layout_seed: got -1; it should be at least 0"),
        ("name", "../../up", "name: got '../../up'; give a name: letters, digits, - and _"),
        ("roads.0.name", "", "roads[0].name: got ''; give a name: text with no space at its ends"),
        ("roads.0.pieces", [], "roads[0].pieces: got []; it should have at least 1 item"),
        ("roads.0.width_m", -7.0, "roads[0].width_m: got -7.0; it should be at least 0.5"),
        ("roads.1.pieces.0.arc_deg", 1e5, "roads[1].pieces[0].arc_deg: got 100000.0; it should"),
        ("roads.1.pieces.0.arc_deg", 0.0, "roads.to_left.pieces[0].arc_deg: is 0; give straight"),
        ("roads.1.start_m", [4e3, 4e3], "roads: cover 4020 m by 4120 m; keep to 1 square kilo"),
        ("roads.0.start_m", [0.0, NAN], "roads[0].start_m[1]: got nan; it should be at"),
        ("roads.0.pieces.0.straight_m", 4990.0, "roads: are 5133 m long together; keep to 5000 m"),
        ("categories.1", "sky", "categories: two are named 'sky'; rename one of them"),
        ("zones.0.from_m", 5.0, "zones.south: has no length; give from_m and to_m that differ"),
        ("zones.0.from_m", 5.5, "zones.south: [5.5, 5.0] m runs backwards; give from_m below to_m"),
        ("closures.0.at_m", 99.0, "closures.left_arm.at_m: 99 m is not on road 'to_left'; stay"),
        (
            "pedestrian_groups.1.walk.at_m",
            99.0,
            "pedestrian_groups.across.walk.at_m: 99 m is not on road 'stem'; stay within 0 and 40",
        ),
        (
            "pedestrian_groups.0.walk.to_m",
            5.0,
            "pedestrian_groups.along.walk: has no length; give from_m and to_m that differ",
        ),
        ("pedestrian_groups.0.speed_mps", [2, 1], "pedestrian_groups[0].speed_mps: got [2, 1]; gi"),
        ("obstacles.0.center_m", [1e9, 0.0], "obstacles[0].center_m[0]: got 1000000000.0; it s"),
    ],
)
def test_values_out_of_range_are_refused(key, value, expected):
    data = yaml.safe_load(CROSSROADS.read_text())
    *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    at = data
    for parent in parents:
        at = at[parent]
    at[last] = value
    assert message_of(data).startswith(f"scene {str(data['name'])!r}: {expected}")


@pytest.mark.parametrize(
    ("key", "changes", "expected"),
    [
        ("building_rows", {"front_m": [0, 0]}, "building_rows[0].front_m[0]: got 0; it should be"),
        ("building_rows", {"front_m": [9, 7]}, "building_rows[0].front_m: got [9, 7]; give [low"),
        ("building_rows", {"to_m": 1e6}, "building_rows[0].to_m: got 1000000.0; it should be at"),
        ("building_rows", {"to_m": 900}, "building_rows[0]: 0 to 900 m is not on road 'stem'; sta"),
        ("obstacle_rows", {"every_m": 1e-9}, "obstacle_rows[0].every_m: got 1e-09; it should be"),
        ("building_rows", {"to_m": -9}, "building_rows[0]: goes from 0 to -9 m; give from_m below"),
        ("obstacle_rows", {"to_m": 0.0}, "obstacle_rows[0]: goes from 0 to 0 m; give from_m below"),
        ("building_rows", {"side": "end"}, "building_rows[0]: is one house across the road's end"),
        ("obstacle_rows", {"every_m": 0.1, "from_m": -99}, "obstacle_rows: could be 1390 "),
    ],
)  # fmt: skip
def test_rows_without_an_end_or_a_length_are_refused(key, changes, expected):
    data = yaml.safe_load(CROSSROADS.read_text())
    row = {"road": "stem", "from_m": 0.0, "to_m": 40.0}
    if key == "building_rows":
        row |= {"side": "left", "setback_m": 2.0, "front_m": [7, 9], "depth_m": [6, 9]}
        row |= {"height_m": [5, 9]}
    else:
        row |= {"kind": "house", "offset_m": 8.0, "every_m": 9.0, "size_m": [1.0, 1.0, 1.0]}
    load_scene(data | {key: [row]})
    assert message_of(data | {key: [row | changes]}).startswith(f"scene 'crossroads': {expected}")


def test_lists_without_end_are_refused():
    data = yaml.safe_load(CROSSROADS.read_text())
    roads = [data["roads"][0] | {"name": f"road{i}"} for i in range(2000)]
    assert "roads: got [" in message_of(data | {"roads": roads})
    pieces = [{"straight_m": 1.0}] * 90
    roads = [data["roads"][0] | {"name": f"road{i}", "pieces": pieces} for i in range(5)]
    # 1 + 2 + 2 of the crossroads', and five times 90.
    expected = "roads: have 455 pieces together; keep to 300"
    assert expected in message_of(data | {"roads": data["roads"] + roads[1:] + roads[:1]})


def test_the_schema_for_editors_is_that_of_the_code():
    assert SCHEMA.read_text(encoding="utf-8") == json_schema(), "make schema"


def test_the_schema_for_editors_knows_every_key_of_our_scenes():
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    for file in (CONF_DIR / "scene").glob("*.yaml"):
        data = yaml.safe_load(file.read_text(encoding="utf-8"))
        assert set(data) <= set(schema["properties"])
        assert set(schema["required"]) <= set(data)
    assert schema["additionalProperties"] is False
    camera = schema["$defs"]["CameraConfig"]["properties"]
    assert (camera["fov_deg"]["minimum"], camera["fov_deg"]["maximum"]) == (1.0, 179.0)
