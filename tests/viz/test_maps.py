"""Pictures: a colour means one thing everywhere, and what is written can be read back."""

import colorsys

import numpy as np
import pytest
import torch

from flowrep import viz
from flowrep.viz import CLASS_COLOURS
from tests.running import run_python


def flow_of(u: float, v: float) -> np.ndarray:
    return np.array([[[u]], [[v]]], dtype=np.float32)


@pytest.mark.parametrize(
    ("u", "v", "rgb"),
    [
        (0.0, 0.0, (255, 255, 255)),
        (4.0, 0.0, (255, 0, 0)),  # right; with the u axis flipped this would be cyan
        (-4.0, 0.0, (0, 255, 255)),
        (0.0, 4.0, (128, 255, 0)),  # down, a quarter of a turn; v upwards gives (128, 0, 255)
        (0.0, -4.0, (128, 0, 255)),
        (1.0, 0.0, (255, 128, 128)),  # a quarter of the scale: half the saturation
        (400.0, 0.0, (255, 0, 0)),  # beyond the scale: full, not wrapped
        *((0.0, bad, (128, 128, 128)) for bad in (np.nan, np.inf, -np.inf)),  # grey
    ],
)
def test_the_colours_of_flow_are_those_worked_by_hand(u, v, rgb):
    assert np.abs(viz.flow_to_rgb(flow_of(u, v), scale_px=4.0)[0, 0].astype(int) - rgb).max() <= 1


def test_the_colours_of_flow_are_those_of_the_hsv_wheel():
    u, v = 1.5, 2.0  # magnitude 2.5, an angle within no axis
    hue = np.arctan2(v, u) / (2 * np.pi)
    expected = 255 * np.array(colorsys.hsv_to_rgb(hue, np.sqrt(2.5 / 10), 1.0))
    assert np.abs(viz.flow_to_rgb(flow_of(u, v), scale_px=10.0)[0, 0] - expected).max() <= 0.51


def test_the_flow_wheel_has_the_colours_of_flow():
    wheel = viz.flow_wheel(101)
    assert wheel[50, 50].tolist() == [255, 255, 255]
    assert wheel[50, 0].tolist() == [0, 255, 255]  # left rim: flow to the left
    assert np.abs(wheel[100, 50].astype(int) - (128, 255, 0)).max() <= 1  # lower rim: down
    assert wheel[0, 0].tolist() == [255, 255, 255]  # outside the disc


def test_classes_have_a_colour_each_in_the_order_of_their_ids():
    scene = pytest.importorskip("flowrep.scenes.scene", exc_type=ImportError)
    from flowrep.simulator import paint

    assert list(CLASS_COLOURS) == list(scene.CATEGORY_ID)
    assert CLASS_COLOURS["sky"] == paint.SKY
    assert len(set(CLASS_COLOURS.values())) == len(CLASS_COLOURS)


def test_classes_have_the_colours_of_the_table_and_unknown_ids_are_grey():
    image = viz.classes_to_rgb(torch.tensor([[[0, 4, 10, 11, 255, 256, -1]]]))
    colours = [CLASS_COLOURS[name] for name in ("sky", "pedestrian", "traffic_light")]
    assert [tuple(pixel) for pixel in image[0].tolist()] == [*colours, *[(128, 128, 128)] * 4]


def test_depth_gets_darker_with_distance_and_is_black_where_nothing_is():
    depth = np.array([[[0.0, 1.0, 9.0, 99.0, 150.0, np.inf, np.nan]]], dtype=np.float32)
    near, *rest, far, further, sky, missing = viz.depth_to_rgb(depth, range_m=99.0)[0].astype(int)
    assert near.tolist() == [252, 253, 191]
    assert far.tolist() == further.tolist() == [40, 16, 80]
    assert sky.tolist() == [0, 0, 0]
    assert missing.tolist() == [128, 128, 128]
    brightness = [colour.sum() for colour in (near, *rest, far, sky)]
    assert brightness == sorted(brightness, reverse=True)
    # log(1 + 9) is half of log(1 + 99): halfway between the third and the fourth of six stops.
    assert np.abs(rest[1] - (212, 75.5, 107)).max() <= 1


def maps(height: int = 30, width: int = 40) -> dict[str, torch.Tensor]:
    return {
        "obj": torch.zeros(2, height, width),
        "rgb": torch.full((3, height, width), 7, dtype=torch.uint8),
        "depth": torch.ones(1, height, width),
        "instance": torch.zeros(1, height, width),
    }


def test_strip_draws_labelled_maps_in_a_fixed_order_enlarged_without_blur():
    given = maps()
    given["obj"][0, 3, 5] = 5.0  # full colour at the default scale
    image = viz.representation_strip(given)
    # rgb, depth and obj, 40 columns enlarged 6 times, 2 gaps of 4; bars of 28 and 20 above 30 rows.
    assert image.shape == (48 + 180, 3 * 240 + 2 * 4, 3)
    assert (image[48:, :240] == 7).all()
    obj = image[48:, 488:]
    assert (obj[18:24, 30:36] == (255, 0, 0)).all()
    assert (np.delete(obj.reshape(30, 6, 40, 6, 3), 3, axis=0) == 255).all()
    labels = image[:28, :240], image[:28, 488:]
    assert all((label < 128).any() for label in labels)
    has_hue = [(label[:, -28:].min(-1) != label[:, -28:].max(-1)).any() for label in labels]
    assert has_hue == [False, True]  # the wheel, of flow alone


@pytest.mark.parametrize("factor", [2, 6])  # an estimator's pictures; as large as the tiles
def test_a_picture_larger_than_the_maps_has_their_size_in_a_strip(factor):
    given = maps()
    rgb = torch.zeros(3, 30 * factor, 40 * factor, dtype=torch.uint8)
    rgb[:, :, 20 * factor :] = 9
    image = viz.representation_strip(given | {"rgb": rgb})
    assert image.shape == viz.representation_strip(given).shape
    assert (image[48:, :120] == 0).all()
    assert (image[48:, 120:240] == 9).all()


def test_a_strip_explains_the_colours_of_the_classes_that_are_named():
    classes, given = ("road", "pedestrian", "traffic_light"), maps(30, 20)
    bare = viz.representation_strip(given)
    told = viz.representation_strip(given, categories=classes)
    legend = told[len(bare) :]
    assert legend.shape == (20, bare.shape[1], 3)
    assert [tuple(legend[10, x]) for x in (8, 128, 248)] == [CLASS_COLOURS[c] for c in classes]
    narrow = viz.representation_strip({"depth": given["depth"]}, categories=classes)
    assert len(narrow) == len(bare) + 3 * 20  # a row for each
    pillar = np.zeros((2, 480, 16), np.float32)  # too narrow for a wheel
    assert viz.representation_strip({"raw": pillar, "obj": pillar}).shape[0] > 480


def test_only_the_named_maps_have_a_frame():
    given = maps(30, 20)
    bare, framed = viz.representation_strip(given), viz.representation_strip(given, framed=["obj"])
    # each of three tiles is 10 px larger, so that they stand at one height
    assert framed.shape == (bare.shape[0] + 10, bare.shape[1] + 30, 3)
    orange = (framed == (230, 97, 1)).all(-1)
    assert orange[0, -170:].all()  # 20 columns enlarged 8 times, and 5 px on either side
    assert not orange[:, :-170].any()


def test_a_grey_map_is_black_at_its_low_end_and_white_at_its_high_end():
    values = np.array([[[-3.0, -1.0, 0.0, 3.0, 9.0, np.nan]]])
    # 0 is a quarter of the way from -1 to 3
    grey = viz.grey_to_rgb(values, -1.0, 3.0)[0]
    assert grey[:5].tolist() == [[v, v, v] for v in (0, 0, 64, 255, 255)]


def test_a_scale_of_one_flow_changes_its_colours_alone():
    flow = torch.full((2, 3, 40), 2.0)
    image = viz.representation_strip({"obj": flow, "ego": flow}, flow_scale_px={"obj": 8.0})
    assert (image[48:, 244:] == viz.flow_to_rgb(flow, 8.0)[0, 0]).all()
    assert (image[48:, :240] == viz.flow_to_rgb(flow, 20.0)[0, 0]).all()  # the others keep theirs


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: viz.flow_to_rgb(np.zeros((3, 4, 2)), 1.0), r"must be \[2, H, W\].*\[3, 4, 2\]"),
        (lambda: viz.flow_to_rgb(flow_of(0, 0), 0.0), "scale_px must be positive"),
        (lambda: viz.depth_to_rgb(np.zeros((4, 4))), r"depth must be \[1, H, W\]"),
        (lambda: viz.representation_strip({"rgb": np.zeros((3, 4, 4))}), "rgb must be uint8"),
        (lambda: viz.representation_strip({"eggo": np.zeros(1)}), "eggo.*expected some of.*'ego'"),
        (lambda: viz.strip({"a": np.zeros((2, 3, 3)), "b": np.zeros((3, 2, 3))}), "needs images"),
    ],
)
def test_maps_that_cannot_be_drawn_are_refused_with_the_reason(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_contact_sheet_stacks_rows_of_different_width():
    wide, narrow = np.zeros((2, 9, 3), np.uint8), np.zeros((3, 4, 3), np.uint8)
    sheet = viz.contact_sheet([wide, narrow])
    assert sheet.shape == (2 + 4 + 3, 9, 3)
    assert (sheet[6:] == [[[0]] * 4 + [[255]] * 5] * 3).all()


def test_png_comes_back_bit_for_bit(tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    viz.write_png(tmp_path / "new" / "folder.png", image)
    assert (np.asarray(pillow.open(tmp_path / "new" / "folder.png")) == image).all()


def test_importing_viz_needs_numpy_alone():
    others = "{'PIL', 'imageio', 'matplotlib', 'torch', 'pybullet'}"
    code = f"import sys, flowrep.viz; print({others} & sys.modules.keys())"
    found = run_python("-c", code, check=True)
    assert found.stdout.strip() == "set()"
