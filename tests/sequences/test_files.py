"""Flow files come back as they were written; a mistake in a recording ends in one line."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

import cv2

from flowrep.sequences import (
    Frames,
    SequenceError,
    Sintel,
    StillVideo,
    TartanAir,
    Tum,
    VKitti2,
    Zed,
    read_flo,
    read_kitti_flow,
    write_flo,
    write_kitti_flow,
)
from tests.sequences import synthetic
from tests.sequences.synthetic import camera_json, png, text
from tests.sequences.test_readers import FORMATS, open_kitti


@pytest.fixture
def flow():
    return np.random.default_rng(0).normal(0, 30, (2, 5, 7)).astype(np.float32)


def test_flo_is_opencvs(flow, tmp_path):
    path = tmp_path / "a.flo"
    write_flo(path, flow)
    np.testing.assert_array_equal(cv2.readOpticalFlow(str(path)).transpose(2, 0, 1), flow)
    cv2.writeOpticalFlow(str(path), np.ascontiguousarray(2 * flow.transpose(1, 2, 0)))
    np.testing.assert_array_equal(read_flo(path), 2 * flow)


def test_unknown_flow_is_marked_as_the_format_says_and_comes_back_as_nan(flow, tmp_path):
    flow[1, 2, 3] = np.nan
    valid = np.ones((5, 7), bool)
    valid[4, 0] = False
    write_flo(tmp_path / "a.flo", flow, valid)
    marked = cv2.readOpticalFlow(str(tmp_path / "a.flo"))
    assert marked[2, 3].tolist() == marked[4, 0].tolist() == [1e10, 1e10]
    back = read_flo(tmp_path / "a.flo")
    assert np.isnan(back).all(0).nonzero()[0].tolist() == [2, 4]
    assert np.isnan(back).sum() == 4


def test_kitti_png_by_hand(tmp_path):
    # u = 1.5 is 2^15 + 96, v = -2 is 2^15 - 128; the third channel says that it is known.
    write_kitti_flow(tmp_path / "a.png", np.array([[[1.5]], [[-2.0]]], np.float32))
    blue_green_red = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert blue_green_red[0, 0, ::-1].tolist() == [32864, 32640, 1]


def test_kitti_png_round_trip_within_half_a_step(flow, tmp_path):
    flow[:, 1, 1] = np.nan
    flow[0, 3, 3] = 600.0  # more than the format can say
    write_kitti_flow(tmp_path / "a.png", flow)
    back = read_kitti_flow(tmp_path / "a.png")
    unknown = np.isnan(back).any(0)
    assert np.argwhere(unknown).tolist() == [[1, 1], [3, 3]]
    assert np.abs(back - flow)[:, ~unknown].max() <= 0.5 / 64


def refusal(read, names) -> str:
    """Returns the error, which has to be one line that names the file."""
    with pytest.raises(SequenceError) as caught:
        list(read())
    message = str(caught.value)
    assert "\n" not in message
    assert names in message.split(": ")[0]
    return message


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("kept", [0.2, 0.99])
def test_a_picture_that_was_cut_off_is_refused(suffix, kept, tmp_path):
    # OpenCV decodes it, with a grey rest.
    synthetic.write_frames(tmp_path)
    picture = np.random.default_rng(0).integers(0, 256, (24, 40, 3), dtype=np.uint8)
    data = cv2.imencode(f".{suffix}", picture)[1].tobytes()
    (tmp_path / "rgb/0001.png").unlink()
    path = tmp_path / f"rgb/0001.{suffix}"
    path.write_bytes(data)
    assert len(list(Frames(tmp_path))) == 3
    path.write_bytes(data[: int(kept * len(data))])
    refusal(lambda: Frames(tmp_path), path.name)


@pytest.mark.parametrize(
    ("kind", "shape", "dtype", "says"),
    [
        ("rgb", (24, 40, 3), np.uint16, "16 bits"),
        ("depth", (24, 40), np.uint8, "expected 1 of 16"),
        ("depth", (24, 40, 3), np.uint16, "expected 1 of 16"),
        ("flow", (24, 40, 3), np.uint8, "expected 3 of 16"),
        ("rgb", (24, 41, 3), np.uint8, "depth 40 x 24, colour 41 x 24"),
        ("depth", (23, 40), np.uint16, "40 x 23, intrinsics.json says 40 x 24"),
        ("flow", (12, 40, 3), np.uint16, "flow 40 x 12"),
    ],
)
def test_a_picture_of_another_type_or_size_is_refused(kind, shape, dtype, says, tmp_path):
    synthetic.write_frames(tmp_path)
    for path in (tmp_path / "flow").iterdir():
        path.unlink()
        png(path.with_suffix(".png"), np.full((24, 40, 3), 2**15, np.uint16))
    png(tmp_path / f"{kind}/0001.png", np.zeros(shape, dtype))
    assert says in refusal(lambda: Frames(tmp_path), "0001.png")


def test_other_files_than_pictures_are_refused(tmp_path):
    synthetic.write_frames(tmp_path)
    (tmp_path / "rgb/0001.png").write_bytes(b"GIF89a" + bytes(50))
    assert "neither a PNG nor a JPEG" in refusal(lambda: Frames(tmp_path), "0001.png")
    path = tmp_path / "a.flo"
    for content in (b"PIEH", struct.pack("<fii", 202021.25, 3, 2) + bytes(47), bytes(60)):
        path.write_bytes(content)
        refusal(lambda: read_flo(path), "a.flo")


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.zeros((24, 40), np.int32), "expected floats"),
        (np.zeros((24, 40, 2), np.float32), "expected [H, W]"),
        (np.array({"a": 1}), "no whole .npy"),
        (None, "no whole .npy"),
    ],
)
def test_an_array_of_another_shape_or_type_is_refused(array, says, tmp_path):
    synthetic.write_tartanair(tmp_path)
    path = tmp_path / "depth_left/000001_left_depth.npy"
    if array is None:  # cut off
        path.write_bytes(path.read_bytes()[:500])
    else:
        np.save(path, array, allow_pickle=True)
    assert says in refusal(lambda: TartanAir(tmp_path), path.name)


def test_depth_that_is_nan_is_missing(tmp_path):
    synthetic.write_frames(tmp_path)
    for i, path in enumerate(sorted((tmp_path / "depth").iterdir())):
        depth = np.full((24, 40), 2.0, np.float32)
        depth[i] = np.nan
        path.unlink()
        np.save(path.with_suffix(".npy"), depth)
    frames = list(Frames(tmp_path))
    assert [np.argwhere(np.isnan(f.depth).all(1)).item() for f in frames] == [0, 1, 2]
    # A unit that is given holds for arrays too: 2.0 in decimetres.
    assert Frames(tmp_path, depth_unit_m=0.1)[0].depth[5, 5] == pytest.approx(0.2)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_names_a_file_that_is_missing_or_empty(name, tmp_path):
    write, open_it, *_ = FORMATS[name]
    write(tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    optional = ("timestamps.txt", "mask.npy", "poses.txt", "groundtruth.txt", "000000.pose.txt")
    # Where the pictures themselves are the list of frames, a missing one is a shorter recording.
    counted = [frame.source for frame in open_it(tmp_path)]
    for path in files:
        content = path.read_bytes()
        path.write_bytes(b"")
        refusal(lambda: open_it(tmp_path), path.name)
        path.unlink()
        if path not in counted and not path.name.endswith(optional):
            with pytest.raises(SequenceError, match=str(tmp_path)):
                list(open_it(tmp_path))
        path.write_bytes(content)


@pytest.mark.parametrize("removed", ["depth/0001.png", "rgb/0001.png", "flow/0001.flo"])
def test_a_frame_that_lacks_a_file_is_named(removed, tmp_path):
    synthetic.write_frames(tmp_path)
    (tmp_path / removed).unlink()
    assert "0001" in refusal(lambda: Frames(tmp_path), removed.split("/")[0])


@pytest.mark.parametrize(
    ("name", "there", "second"),
    [
        ("sevenscenes", "frame-000001.color.png", "frame-000001.color.jpg"),
        ("frames", "depth/0001.png", "depth/0001.npy"),
        ("zed", "depth000001.npy", "depth000001.PNG"),
    ],
)
def test_two_files_of_one_frame_are_refused(name, there, second, tmp_path):
    write, open_it, *_ = FORMATS[name]
    write(tmp_path)
    (tmp_path / second).write_bytes((tmp_path / there).read_bytes())
    assert "remove one" in refusal(lambda: open_it(tmp_path), "0001")


def test_frames_of_differing_sizes_are_refused(tmp_path):
    synthetic.write_tum(tmp_path)
    for kind, dtype, shape in (("rgb", np.uint8, (12, 20, 3)), ("depth", np.uint16, (12, 20))):
        png(sorted((tmp_path / kind).iterdir())[2], np.zeros(shape, dtype))
    says = refusal(lambda: Tum(tmp_path), "rgb/100.200000.png")
    assert "20 x 12, other frames are 40 x 24" in says


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("nan nan nan 0 nan nan nan 0 nan nan nan 0 0 0 0 1", "nan"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "not rigid"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "left-handed"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1", "last row"),
        ("1 0 0", "expected 12 or 16"),
        ("0 0 0 0 0 0 1", "pose_layout=xyz_xyzw"),
        ("one", "not numbers"),
        ("# nothing", "no numbers"),
    ],
)
def test_poses_that_are_none_are_refused(line, says, tmp_path):
    synthetic.write_frames(tmp_path)
    text(tmp_path / "poses.txt", [line] * 3)
    assert says in refusal(lambda: Frames(tmp_path), "poses.txt")
    text(tmp_path / "poses.txt", ["1 0 0 0 0 1 0 0 0 0 1 0"] * 2)
    assert "2 poses for 3 frames" in refusal(lambda: Frames(tmp_path), "poses.txt")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": None}, "fx"),
        ({"fx": -31.0}, "fx"),
        ({"fy": -27.0}, "left-handed"),  # ICL-NUIM's: no camera axes turn it
        ({"width": 40.9}, "width"),
        ({"height": float("nan")}, "height"),
        ({"first_pixel_centre": 1}, "first_pixel_centre"),
        ({"colour": []}, "colour"),
        ({"colour": {}}, "colour_from_depth"),
        ({"width": 60, "height": 36}, "intrinsics.json says 60 x 36"),
    ],
)
@pytest.mark.parametrize("name", ["frames", "zed"])
def test_intrinsics_that_are_none_are_refused(name, change, says, tmp_path):
    write, open_it, *_ = FORMATS[name]
    write(tmp_path)
    text(tmp_path / "intrinsics.json", [json.dumps(camera_json() | change)])
    assert says in refusal(lambda: open_it(tmp_path), "0.png" if "60" in says else "intrinsics")


@pytest.mark.parametrize(
    ("content", "says"), [("{", "JSON"), ("[]", "object"), ("{}", "width"), (None, "width")]
)
def test_an_intrinsics_file_says_what_it_lacks(content, says, tmp_path):
    synthetic.write_frames(tmp_path)
    path = tmp_path / "intrinsics.json"
    path.unlink() if content is None else path.write_text(content)
    assert says in refusal(lambda: Frames(tmp_path), "intrinsics.json")


@pytest.mark.parametrize(
    ("name", "lines", "says"),
    [
        ("rgb.txt", ["2.0 rgb/b.png", "1.0 rgb/a.png"], "backwards"),
        ("groundtruth.txt", ["2 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], "backwards"),
        ("groundtruth.txt", ["nan 0 0 0 0 0 0 1"], "not a number"),
        ("groundtruth.txt", ["1.0 0 0 0"], "expected 8"),
        ("depth.txt", ["1.0"], "line 1"),
        ("depth.txt", ["# none"], "no pictures"),
        ("rgb.txt", None, "<time> rgb/<file>"),
    ],
)
def test_tum_index_files(name, lines, says, tmp_path):
    synthetic.write_tum(tmp_path)
    (tmp_path / name).unlink() if lines is None else text(tmp_path / name, lines)
    assert says in refusal(lambda: Tum(tmp_path), name)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("R_rect_00: 1.0 0.0 0.0", "R_rect_00: 0.0 0.0 0.0", "not rigid"),
        ("P_rect_02: 31.0 0.0", "P_rect_02: 31.0 1.0", "P_rect_02"),
        ("P_rect_02: 31.0", "P_rect_02: nan", "P_rect_02"),
    ],
)
def test_kitti_cameras_that_are_none_are_refused(before, after, says, tmp_path):
    synthetic.write_kitti(tmp_path)
    path = tmp_path / "training/calib_cam_to_cam/000000.txt"
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    assert says in refusal(lambda: open_kitti(tmp_path), "calib_cam_to_cam/000000.txt")


def test_cameras_and_frames_that_a_format_lacks(tmp_path):
    synthetic.write_sintel(tmp_path / "s")
    path = next((tmp_path / "s").rglob("*.cam"))
    path.write_bytes(path.read_bytes()[:60])
    refusal(lambda: Sintel(tmp_path / "s", scene="cave"), path.name)
    synthetic.write_vkitti2(tmp_path / "v")
    path = tmp_path / "v/extrinsic.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    assert "frame 1" in refusal(lambda: VKitti2(tmp_path / "v"), "extrinsic.txt")
    synthetic.write_zed(tmp_path / "z")
    text(tmp_path / "z/poses.txt", ["0 0 0 0 0 0 0"] * 3)
    assert "quaternion" in refusal(lambda: Zed(tmp_path / "z"), "poses.txt")


def test_a_moving_camera_needs_depth_and_a_video_has_none(tmp_path):
    assert "format.still=true" in refusal(lambda: StillVideo(0), "0")
    path = tmp_path / "a.mp4"
    refusal(lambda: StillVideo(path, still=True), "a.mp4")
    path.write_bytes(b"no video at all")
    refusal(lambda: StillVideo(path, still=True), "a.mp4")
