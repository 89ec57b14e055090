"""Files that nobody vouches for end in one line that names the file and the cause."""

from __future__ import annotations

import json
import math
import struct
import zlib

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.sequences import (
    Frames,
    SequenceError,
    Sintel,
    StillVideo,
    TartanAir,
    Tum,
    VKitti2,
    Zed,
    ZedLive,
    read_flo,
    read_kitti_flow,
)
from tests.sequences import synthetic
from tests.sequences.synthetic import png, text
from tests.sequences.test_readers import FORMATS, open_kitti


def refusal(read, names) -> str:
    """Returns what is said, which has to be one line that names the file."""
    with pytest.raises(SequenceError) as caught:
        read()
    message = str(caught.value)
    assert "\n" not in message
    assert names in message.split(": ")[0]
    return message


def all_of(recording):
    return list(recording)


def png_of_size(width, height):
    """Returns a whole PNG whose header claims a size, with next to no data behind it."""

    def chunk(name, data):
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(100))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    )


PICTURES = {
    "empty": (b"", "is empty"),
    "other": (b"GIF89a" + bytes(50), "is neither a PNG nor a JPEG"),
    "huge": (png_of_size(2**31 - 1, 2**31 - 1), "claims 2147483647 x 2147483647 pixels"),
    "wide": (png_of_size(2**30, 1), "claims 1073741824 x 1 pixels"),
    "flat": (png_of_size(0, 7), "claims 0 x 7 pixels"),
    "hollow": (png_of_size(40, 24), "can't be decoded"),
    "jpeg": (b"\xff\xd8\xff\xe0\x00\x10" + bytes(14), "is a JPEG that was cut off"),
    "huge jpeg": (
        b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff" + bytes(30),
        "claims 65535 x 65535 pixels",
    ),
}


@pytest.mark.parametrize("what", PICTURES)
def test_pictures(what, tmp_path):
    synthetic.write_frames(tmp_path)
    content, says = PICTURES[what]
    (tmp_path / "rgb/0001.png").write_bytes(content)
    assert says in refusal(lambda: all_of(Frames(tmp_path)), "rgb/0001.png")


@pytest.mark.parametrize("kept", [0.2, 0.6, 0.99])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_picture_that_was_cut_off_is_none(suffix, kept, tmp_path):
    import cv2

    synthetic.write_frames(tmp_path)
    picture = np.random.default_rng(0).integers(0, 256, (24, 40, 3), dtype=np.uint8)
    data = cv2.imencode(f".{suffix}", picture)[1].tobytes()
    (tmp_path / "rgb/0001.png").unlink()
    path = tmp_path / f"rgb/0001.{suffix}"
    path.write_bytes(data)
    assert len(all_of(Frames(tmp_path))) == 3
    path.write_bytes(data[: int(kept * len(data))])
    assert "cut off" in refusal(lambda: all_of(Frames(tmp_path)), path.name)


def test_a_picture_with_a_flipped_bit_is_none(tmp_path):
    synthetic.write_frames(tmp_path)
    path = tmp_path / "depth/0001.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    assert "corrupt" in refusal(lambda: all_of(Frames(tmp_path)), "depth/0001.png")


@pytest.mark.parametrize(
    ("kind", "shape", "dtype", "says"),
    [
        ("rgb", (24, 40, 3), np.uint16, "has 16 bits a channel, colour has 8"),
        ("depth", (24, 40), np.uint8, "should have one channel of 16 bits, has 1 of 8"),
        ("depth", (24, 40, 3), np.uint16, "should have one channel of 16 bits, has 3 of 16"),
        ("flow", (24, 40, 3), np.uint8, "should have three channels of 16 bits, has 3 of 8"),
        ("rgb", (24, 41, 3), np.uint8, "differ in size: depth 40 x 24, colour 41 x 24"),
        ("depth", (23, 40), np.uint16, "is 40 x 23, intrinsics.json says 40 x 24"),
        ("flow", (12, 40, 3), np.uint16, "differ in size: depth 40 x 24, colour 40 x 24, flow"),
    ],
)  # fmt: skip
def test_wrong_depths_of_bits_and_sizes(kind, shape, dtype, says, tmp_path):
    synthetic.write_frames(tmp_path)
    (tmp_path / "flow/0001.flo").unlink()
    png(tmp_path / "flow/0001.png", np.full((24, 40, 3), 2**15, np.uint16))
    png(tmp_path / f"{kind}/0001.png", np.zeros(shape, dtype))
    assert says in refusal(lambda: all_of(Frames(tmp_path)), "0001.png")


@pytest.mark.parametrize(
    ("write", "open_it"), [(synthetic.write_frames, Frames), (synthetic.write_zed, Zed)]
)
def test_pictures_of_another_size_than_their_camera_has(write, open_it, tmp_path):
    write(tmp_path)
    larger = synthetic.camera_json(size=(36, 60))
    text(tmp_path / "intrinsics.json", [json.dumps(larger)])
    said = refusal(lambda: all_of(open_it(tmp_path)), "0.png")
    assert "is 40 x 24, intrinsics.json says 60 x 36" in said


def test_frames_of_differing_sizes(tmp_path):
    synthetic.write_tum(tmp_path)
    for kind, dtype, shape in (("rgb", np.uint8, (12, 20, 3)), ("depth", np.uint16, (12, 20))):
        path = sorted((tmp_path / kind).iterdir())[2]
        png(path, np.zeros(shape, dtype))
    said = refusal(lambda: all_of(Tum(tmp_path)), "rgb/100.200000.png")
    assert "is 20 x 12, other frames are 40 x 24" in said


@pytest.mark.parametrize(
    ("name", "there", "second"),
    [
        ("sevenscenes", "frame-000001.color.png", "frame-000001.color.jpg"),
        ("frames", "depth/0001.png", "depth/0001.npy"),
        ("frames", "rgb/0001.png", "rgb/0001.jpeg"),
        ("zed", "depth000001.npy", "depth000001.PNG"),
    ],
)
def test_two_files_of_one_frame(name, there, second, tmp_path):
    write, open_it, *_ = FORMATS[name]
    write(tmp_path)
    (tmp_path / second).write_bytes((tmp_path / there).read_bytes())
    first, later = sorted([there, second])
    said = refusal(lambda: open_it(tmp_path), later)
    assert f"belongs to the same frame as {first.split('/')[-1]}; remove one" in said


def test_two_frames_of_one_name(tmp_path):
    synthetic.write_tum(tmp_path)
    path = tmp_path / "rgb.txt"
    path.write_text(path.read_text().replace("rgb/100.200000.png", "rgb/100.000000.png"))
    recording = Tum(tmp_path)
    said = refusal(lambda: all_of(recording), "rgb/100.000000.png")
    assert "frame 2 is named 100.000000, like frame 0 (" in said
    assert [recording[0].name for _ in range(2)] == ["100.000000"] * 2  # read again, it is itself


FLO = struct.pack("<fii", 202021.25, 3, 2)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"PIEH", "does not begin with the number"),
        (struct.pack("<fii", 1.0, 3, 2) + bytes(48), "does not begin with the number"),
        (struct.pack("<fii", 202021.25, 2**31 - 1, 2**31 - 1), "claims 2147483647 x 2147483647"),
        (struct.pack("<fii", 202021.25, -3, -2) + bytes(48), "claims -3 x -2 pixels"),
        (FLO + bytes(47), "claims 3 x 2, 60 bytes, and has 59"),
        (FLO + bytes(49), "claims 3 x 2, 60 bytes, and has 61"),
    ],
)
def test_flo_files(content, says, tmp_path):
    path = tmp_path / "a.flo"
    path.write_bytes(content)
    assert says in refusal(lambda: read_flo(path), "a.flo")


def npy(header, data=b"", version=b"\x01\x00"):
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\x93NUMPY", "no readable .npy header"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2147483648, 2147483648), }"),
         "claims 2147483648 x 2147483648"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (24, 40), }", b"cos\nsystem\n"),
         "holds object, expected floats"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (24, 40), }", bytes(9)),
         "claims 3,840 bytes of data and has 9"),
        (npy("{'descr': '<i4', 'fortran_order': False, 'shape': (24, 40), }", bytes(3840)),
         "holds int32, expected floats"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (960,), }", bytes(3840)),
         "holds an array [960], expected [H, W]"),
        (npy("__import__('os').system('true')"), "no readable .npy header"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-24, -40), }", bytes(3840)),
         "claims -40 x -24"),
    ],
)  # fmt: skip
def test_npy_files(content, says, tmp_path):
    synthetic.write_tartanair(tmp_path)
    (tmp_path / "depth_left/000001_left_depth.npy").write_bytes(content)
    assert says in refusal(lambda: all_of(TartanAir(tmp_path)), "000001_left_depth.npy")


NAN_ROTATION = "nan nan nan 0 nan nan nan 0 nan nan nan 0 0 0 0 1"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([], "is empty"),
        (["# nothing"], "holds no numbers"),
        ([NAN_ROTATION] * 3, "holds nan"),
        (["2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"] * 3, "is not rigid"),
        (["1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1"] * 3, "left-handed"),
        (["1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1"] * 3, "last row"),
        (["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"] * 2, "has 2 poses for 3 frames"),
        (["1 0 0"] * 3, "line 1 has 3 numbers, expected 12 or 16"),
        (["1 0 0 0 0 1 0 0 0 0 1 0", "one"], "line 2: 'one' is not a number"),
    ],
)
def test_poses(lines, says, tmp_path):
    synthetic.write_frames(tmp_path)
    text(tmp_path / "poses.txt", lines)
    assert says in refusal(lambda: all_of(Frames(tmp_path)), "poses.txt")


def test_missing_poses_say_what_to_do(tmp_path):
    synthetic.write_frames(tmp_path)
    (tmp_path / "poses.txt").unlink()
    said = refusal(lambda: Frames(tmp_path), "poses.txt")
    assert "can't be factorised without the camera's poses" in said
    assert "format=video" in said


def test_a_quaternion_that_is_none(tmp_path):
    synthetic.write_zed(tmp_path)
    text(tmp_path / "poses.txt", ["0 0 0 0 0 0 0"] * 3)
    assert "a quaternion must have length 1" in refusal(lambda: all_of(Zed(tmp_path)), "poses.txt")


@pytest.mark.parametrize(
    ("name", "lines", "says"),
    [
        ("rgb.txt", ["1.0 ../../etc/passwd"], "names '../../etc/passwd', which lies outside"),
        ("rgb.txt", ["1.0 /etc/passwd"], "names '/etc/passwd', which lies outside"),
        ("depth.txt", ["1.0 a/../../b.png"], "lies outside"),
        ("rgb.txt", ["1.0 " + 5000 * "9"], "names a file by 5,000 characters"),
        ("rgb.txt", ["2.0 rgb/b.png", "1.0 rgb/a.png"], "timestamps go backwards: 1.000000"),
        ("groundtruth.txt", ["2 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], "timestamps go backwards"),
        ("groundtruth.txt", ["nan 0 0 0 0 0 0 1"], "a timestamp that is not a number"),
        ("groundtruth.txt", ["1.0 0 0 0"], "line 1 has 4 numbers, expected 8"),
        ("depth.txt", ["1.0"], "line 1 is not a timestamp and file name"),
        ("depth.txt", ["# none"], "names no pictures"),
    ],
)
def test_tum_index_files(name, lines, says, tmp_path):
    synthetic.write_tum(tmp_path)
    text(tmp_path / name, lines)
    assert says in refusal(lambda: all_of(Tum(tmp_path)), name)


def test_binary_where_text_should_be(tmp_path):
    synthetic.write_tum(tmp_path)
    (tmp_path / "rgb.txt").write_bytes(b"\xff\xfe\x00\x80" * 9)
    assert "is not text" in refusal(lambda: Tum(tmp_path), "rgb.txt")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": None}, "fx should be a number"),
        ({"fx": -31.0}, "fx and fy should be positive"),
        ({"width": 40.9}, "width should be a whole number, not 40.9"),
        ({"height": 24.5}, "height should be a whole number, not 24.5"),
        ({"fx": float("nan")}, "fx should be a number"),
        ({"width": 2**31, "height": 2**31}, "claims 2147483648 x 2147483648"),
        ({"first_pixel_centre": 1}, "first_pixel_centre is 0"),
        ({"colour": []}, "colour should be an object"),
        ({"colour": {}}, "colour_from_depth should be four rows"),
    ],
)
def test_intrinsics(change, says, tmp_path):
    synthetic.write_frames(tmp_path)
    text(tmp_path / "intrinsics.json", [json.dumps(synthetic.camera_json() | change)])
    assert says in refusal(lambda: Frames(tmp_path), "intrinsics.json")


@pytest.mark.parametrize(
    ("content", "says"),
    [("{", "is not JSON"), ("[]", "should be a JSON object"), ("{}", "lacks width, height, fx"),
     ("[" * 100_000, "is not JSON")],
    ids=["half", "list", "empty", "deep"],
)  # fmt: skip
def test_intrinsics_that_are_none(content, says, tmp_path):
    synthetic.write_frames(tmp_path)
    (tmp_path / "intrinsics.json").write_text(content)
    assert says in refusal(lambda: Frames(tmp_path), "intrinsics.json")


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_names_a_file_that_is_missing_or_empty(name, tmp_path):
    write, open_it, *_ = FORMATS[name]
    write(tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    optional = ("timestamps.txt", "mask.npy")
    # Where the pictures themselves are the list of frames, a missing one is a shorter recording.
    recording = open_it(tmp_path)
    frames, counted = len(recording), [frame.source for frame in recording]
    for path in files:
        content = path.read_bytes()
        path.write_bytes(b"")
        refusal(lambda: all_of(open_it(tmp_path)), path.name)
        path.unlink()
        if path not in counted and not path.name.endswith(optional):
            with pytest.raises(SequenceError) as caught:
                all_of(open_it(tmp_path))
            assert str(tmp_path) in str(caught.value)
        path.write_bytes(content)
    assert len(all_of(open_it(tmp_path))) == frames


@pytest.mark.parametrize("change", [{(2, 0): 31.5}, {(0, 0): -1.0}, {(1, 2): math.inf}])
def test_a_sintel_camera_that_is_none(change, tmp_path):
    synthetic.write_sintel(tmp_path)
    path = next(tmp_path.rglob("*.cam"))
    K = np.frombuffer(path.read_bytes(), "<f8", 9, offset=4).reshape(3, 3).copy()
    for place, value in change.items():
        K[place] = value
    path.write_bytes(path.read_bytes()[:4] + K.tobytes() + path.read_bytes()[4 + 72 :])
    said = refusal(lambda: all_of(Sintel(tmp_path, scene="cave")), "")
    assert "intrinsics should have the rows (fx, skew, cx)" in said


def test_a_scene_that_leads_out_of_the_folder(tmp_path):
    assert "is the name of a folder" in refusal(lambda: Sintel(tmp_path, scene="../.."), "")


def test_kitti_mapping_that_leads_out_of_the_folder(tmp_path):
    synthetic.write_kitti(tmp_path)
    text(tmp_path / "train_mapping.txt", ["../.. 2011_09_26_drive_0005_sync 0000000059"])
    assert "lies outside" in refusal(lambda: open_kitti(tmp_path), "train_mapping.txt")


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("R_rect_00: 1.0 0.0 0.0", "R_rect_00: 0.0 0.0 0.0", "not rigid"),
        ("P_rect_02: 31.0 0.0", "P_rect_02: 0.0 0.0", "P_rect_02 should be K [I | t]"),
        ("P_rect_02: 31.0 0.0", "P_rect_02: 31.0 1.0", "P_rect_02 should be K [I | t]"),
        ("P_rect_02: 31.0", "P_rect_02: nan", "P_rect_02 should be 12 numbers"),
    ],
)
def test_kitti_cameras_that_are_none(before, after, says, tmp_path):
    synthetic.write_kitti(tmp_path)
    path = tmp_path / "training/calib_cam_to_cam/000000.txt"
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    assert says in refusal(lambda: all_of(open_kitti(tmp_path)), "calib_cam_to_cam/000000.txt")


def test_a_kitti_frame_number_without_end(tmp_path):
    synthetic.write_kitti(tmp_path)
    path = tmp_path / "train_mapping.txt"
    path.write_text(path.read_text().replace("0000000059", 5000 * "9"))
    said = refusal(lambda: open_kitti(tmp_path), "train_mapping.txt")
    assert "line 1 is not a date, recording and frame" in said


def test_kitti_flow_png_of_another_kind(tmp_path):
    png(tmp_path / "a.png", np.zeros((4, 5), np.uint16))
    assert "three channels" in refusal(lambda: read_kitti_flow(tmp_path / "a.png"), "a.png")


def test_virtual_kitti_frames_without_a_pose(tmp_path):
    synthetic.write_vkitti2(tmp_path)
    path = tmp_path / "extrinsic.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    said = refusal(lambda: all_of(VKitti2(tmp_path)), "extrinsic.txt")
    assert "no pose or intrinsics of frame 1" in said


def test_a_video_has_neither_poses_nor_depth(tmp_path):
    said = refusal(lambda: StillVideo(0), "0")
    assert "a video gives neither poses nor depth" in said
    assert "tum, sevenscenes, zed, zed_live, frames" in said
    path = tmp_path / "a.mp4"
    assert "no such file" in refusal(lambda: StillVideo(path, still=True), "a.mp4")
    path.write_bytes(b"no video at all")
    assert "can't open it" in refusal(lambda: list(StillVideo(path, still=True)), "a.mp4")


def test_without_the_sdk_the_live_zed_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyzed", None)
    assert "needs Stereolabs' ZED SDK" in refusal(lambda: ZedLive("live"), "zed_live")
