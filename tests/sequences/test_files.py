"""Flow files come back as they were written; a mistake in a recording ends in one line."""

import contextlib
import io
import os
import re
import signal
import struct
import zlib
from functools import partial

import cv2
import numpy as np
import pytest

from flowrep import sequences
from flowrep.sequences.factorization import pairs
from tests.sequences import synthetic
from tests.sequences.synthetic import camera_json, put
from tests.sequences.test_readers import FORMATS, written


@pytest.fixture
def flow():
    return np.random.default_rng(0).normal(0, 30, (2, 5, 7)).astype(np.float32)


def test_flo_is_opencvs(flow, tmp_path):
    path = tmp_path / "a.flo"
    sequences.write_flo(path, flow)
    np.testing.assert_array_equal(cv2.readOpticalFlow(str(path)).transpose(2, 0, 1), flow)
    cv2.writeOpticalFlow(str(path), np.ascontiguousarray(2 * flow.transpose(1, 2, 0)))
    np.testing.assert_array_equal(sequences.read_flow(path), 2 * flow)
    # Unknown flow is marked as the format says, and comes back as nan.
    flow[1, 2, 3] = np.nan
    valid = np.ones((5, 7), bool)
    valid[4, 0] = False
    sequences.write_flo(path, flow, valid)
    marked = cv2.readOpticalFlow(str(path))
    assert marked[2, 3].tolist() == marked[4, 0].tolist() == [1e10, 1e10]
    back = sequences.read_flow(path)
    assert np.isnan(back).all(0).nonzero()[0].tolist() == [2, 4]
    assert np.isnan(back).sum() == 4


def test_kitti_png_by_hand_and_back_within_half_a_step(flow, tmp_path):
    # u = 1.5 is 2^15 + 96, v = -2 is 2^15 - 128; the third channel says that it is known.
    flow[:, 0, 0] = 1.5, -2.0
    flow[:, 1, 1] = np.nan
    flow[0, 3, 3] = 600.0  # more than the format can say
    path = tmp_path / "a.png"
    sequences.write_kitti_flow(path, flow)
    blue_green_red = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert blue_green_red[0, 0, ::-1].tolist() == [32864, 32640, 1]
    back = sequences.read_flow(path)
    unknown = np.isnan(back).any(0)
    assert np.argwhere(unknown).tolist() == [[1, 1], [3, 3]]
    assert np.abs(back - flow)[:, ~unknown].max() <= 0.5 / 64


def refusal(read, name) -> str:
    """Returns the error, which has to be one line that names the file."""
    with pytest.raises((sequences.SequenceError, OSError), match=re.escape(name)) as caught:
        list(pairs(read()))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def hang_is_a_failure():
    def too_long(*_):
        raise TimeoutError("it waits for the pipe")

    previous = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.usefixtures("hang_is_a_failure")
def test_every_format_names_a_file_that_is_missing_or_empty_and_waits_for_no_pipe(name, tmp_path):
    _, open_it = written(name, tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    optional = ("timestamps.txt", "poses.txt", "groundtruth.txt", "extrinsic.txt")
    optional += ("pose_left.txt", "000000.pose.txt")
    # Where the pictures themselves are the list of frames, a missing one is a shorter recording.
    counted = [] if name == "frames" else [frame.source for frame in open_it()]
    for path in files:
        content = path.read_bytes()
        path.write_bytes(b"")
        refusal(open_it, path.name)
        path.unlink()
        if path not in counted and not path.name.endswith(optional):
            refusal(open_it, str(tmp_path))
        os.mkfifo(path)
        with contextlib.suppress(sequences.SequenceError):  # what is optional is not there
            list(open_it())
        path.unlink()
        path.write_bytes(content)


def flo(width, height, size) -> bytes:
    return struct.pack("<fii", 202021.25, width, height) + bytes(size)


def npy_header(shape) -> bytes:
    file = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


def png_header(width, height) -> bytes:
    parts = (b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0), b"IDAT", b"IEND")
    chunks = (struct.pack(">I", len(p) - 4) + p + struct.pack(">I", zlib.crc32(p)) for p in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


POSE, PICTURE = "1 0 0 0 0 1 0 0 0 0 1 0", np.zeros((24, 40, 3), np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, (24, 40, 3), dtype=np.uint8)
PNG, JPEG = (cv2.imencode(suffix, NOISE)[1].tobytes() for suffix in (".png", ".jpg"))
PREVIEW = "images/scene_cam_00_final_preview/frame.0001.tonemap.jpg"
# Format, file, what it holds, and words of the error beside the file's name.
MISTAKES = [
    ("frames", "rgb/0001.png", PICTURE.astype(np.uint16), "16 bits"),
    ("frames", "rgb/0001.png", PICTURE[:, :-1], "[24, 39] rows and columns"),
    ("frames", "rgb/0001.png", b"GIF89a" + bytes(50), ".png"),
    # Of these, OpenCV decodes the beginning, with a grey rest.
    ("frames", "rgb/0001.png", PNG[: len(PNG) * 99 // 100], "cut off"),
    ("hypersim", PREVIEW, JPEG[: len(JPEG) // 5], "cut off"),
    ("frames", "depth/0001.png", PICTURE[..., 0], "uint8"),
    ("frames", "depth/0001.png", np.zeros((23, 40), np.uint16), "depth 40 x 23, colour 40 x 24"),
    ("frames", "depth/0001.npy", np.zeros((24, 40), np.float32), "remove one"),
    ("zed", "depth000001.npy", np.zeros((24, 40), bool), "bool"),
    ("zed", "depth000001.npy", np.zeros((24, 40, 2), np.float32), "[24, 40, 2]"),
    ("zed", "depth000001.npy", b"\x93NUMPY\x01\x00", ".npy"),
    ("zed", "depth000001.npy", npy_header((400_000, 400_000)), ".npy"),  # 596 GiB
    # Neither is decoded: the first is larger than a frame, the second than Pillow's own limit.
    ("frames", "rgb/0001.png", png_header(30_000, 5_000), "pixels"),
    ("frames", "rgb/0001.png", png_header(30_000, 30_000), "pixels"),
    ("frames", "flow/0001.flo", flo(-40, -24, 8 * 40 * 24), "is no .flo"),
    ("frames", "flow/0001.flo", flo(40, -1, 8 * 40 * 24), "is no .flo"),
    ("frames", "flow/0001.flo", flo(0, 24, 0), "is no .flo"),
    ("sintel", "depth/cave/frame_0001.dpt", flo(-40, -24, 4 * 40 * 24), "is no .dpt"),
    ("frames", "flow/0001.flo", flo(40, 12, 3840), "flow 40 x 12"),
    ("frames", "flow/0001.flo", flo(40, 24, 3840), "960"),
    ("frames", "poses.txt", [3 * "nan nan nan 0 " + "0 0 0 1"] * 3, "nan"),
    ("frames", "poses.txt", ["2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"] * 3, "not rigid"),
    ("frames", "poses.txt", ["1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1"] * 3, "left-handed"),
    ("frames", "poses.txt", ["1 0 0"] * 3, "3 numbers a pose"),
    ("frames", "poses.txt", ["0 0 0 0 0 0 1"] * 3, "pose_layout=xyz_xyzw"),
    ("frames", "poses.txt", ["# nothing"], "no numbers"),
    ("frames", "poses.txt", [POSE] * 2, "2 rows for 3 frames"),
    ("zed", "poses.txt", ["0 0 0 0 0 0 0"] * 3, "lost"),
    ("frames", "intrinsics.json", camera_json(fx=-31.0), "fx"),
    ("frames", "intrinsics.json", camera_json(fy=-27.0), "left-handed"),  # no camera axes turn it
    ("frames", "intrinsics.json", camera_json(first_pixel_centre=1), "first_pixel_centre"),
    # What is ignored makes flow wrong without a word.
    ("frames", "intrinsics.json", camera_json(colour={"fx": 30.0}), "colour"),
    ("frames", "intrinsics.json", camera_json(distortions=[0.1, 0, 0, 0]), "distortions"),
    ("frames", "intrinsics.json", ["{"], "JSON"),
    ("frames", "timestamps.txt", ["0,033", "0,066", "0,100"], "has 2 numbers in a row"),
    ("frames", "timestamps.txt", ["0 0.0", "1 0.1", "2 0.2"], "has 2 numbers in a row"),
    ("kubric", "metadata.json", ["[" * 200_000], "RecursionError"),
    ("kubric", "data_ranges.json", ['{"backward_flow": {"min": 1%s}}' % ("0" * 400)], "too large"),
    ("tum", "rgb.txt", ["2.0 rgb/b.png", "1.0 rgb/a.png"], "backwards"),
    ("tum", "groundtruth.txt", ["2 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], "backwards"),
    ("tum", "groundtruth.txt", ["1.0 0 0 0"], "3 numbers a pose"),
    ("tum", "depth.txt", ["1.0"], "<time> <file>"),
    ("tum", "depth.txt", ["# none"], "depth.txt"),
    ("tum", "depth.txt", ["1 depth/a.png", "2 depth/a.png"], "same name"),
    ("sintel", "camdata_left/cave/frame_0001.cam", bytes(60), "no table"),
    ("sevenscenes", "frame-000001.pose.txt", ["1 0 0 0"], "4 numbers"),
    ("kitti", "calib_cam_to_cam/000000.txt", ["P_rect_02: 1 2 3"], "P_rect_03"),
]


@pytest.mark.parametrize(("name", "file", "content", "says"), MISTAKES)
def test_a_mistake_ends_in_a_line_that_names_the_file(name, file, content, says, tmp_path):
    _, open_it = written(name, tmp_path)
    put(tmp_path / file, content)
    # Where sizes differ, it is the frame's.
    named = "0001.png" if "flow 40" in says else file.split("/")[-1]
    assert says in refusal(open_it, named)


def test_a_file_that_is_larger_than_any_table_or_a_pipe_is_not_read(tmp_path):
    synthetic.write_frames(tmp_path)
    with (tmp_path / "poses.txt").open("r+b") as file:
        file.truncate(2**31)  # takes no room on disk
    assert "bytes" in refusal(lambda: sequences.open_recording(tmp_path, "frames"), "poses.txt")
    (tmp_path / "rgb.mp4").mkdir()  # no regular file, as a pipe is none
    read = partial(sequences.open_recording, tmp_path, "frames", rgb="rgb.mp4")
    assert "regular" in refusal(read, "rgb.mp4")


def test_an_hdf5_file_of_two_arrays_or_none_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py", reason="pip install 'flowrep-rl[hdf5]'")
    depth = synthetic.write_frames(tmp_path)[1].depth
    (tmp_path / "depth/0001.png").unlink()
    for names in (["a/z"], ["a/z", "b"]):
        with h5py.File(tmp_path / "depth/0001.h5", "w") as stored:
            for name in names:
                stored[name] = depth
        if len(names) == 1:
            read = sequences.open_recording(tmp_path, "frames")[1].depth
            np.testing.assert_array_equal(read, depth)
    assert "2 arrays" in refusal(lambda: sequences.open_recording(tmp_path, "frames"), "0001.h5")
    (tmp_path / "depth/0001.h5").write_bytes(b"no HDF5")
    refusal(lambda: sequences.open_recording(tmp_path, "frames"), "0001.h5")


def test_frames_of_differing_sizes_are_refused(tmp_path):
    synthetic.write_tum(tmp_path)
    for kind, dtype, shape in (("rgb", np.uint8, (12, 20, 3)), ("depth", np.uint16, (12, 20))):
        put(sorted((tmp_path / kind).iterdir())[2], np.zeros(shape, dtype))
    says = refusal(lambda: sequences.open_recording(tmp_path, "tum"), "rgb/100.200000.png")
    assert "20 x 12, the frame before 40 x 24" in says


def test_a_moving_camera_needs_depth_and_a_video_has_none(tmp_path):
    assert "format.still=true" in refusal(lambda: sequences.StillVideo(0), "0")
    path = tmp_path / "a.mp4"
    refusal(lambda: sequences.StillVideo(path, still=True), "a.mp4")
    path.write_bytes(b"no video at all")
    refusal(lambda: sequences.StillVideo(path, still=True), "a.mp4")
