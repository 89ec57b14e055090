"""Bags of ROS 1 and 2, written by the library's own writers."""

import os
import struct

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from flowrep.sequences import SequenceError, open_recording
from tests.geometry.scenes import rigid
from tests.sequences.synthetic import HEIGHT, OPENCV_K, WIDTH, K, make_moments, stored

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 100_000_000
BASE_FROM_CAM = rigid((0.3, -0.2, 0.1), (-1.5, 0.1, -1.6)).numpy()
TF = "geometry_msgs/TransformStamped[] transforms"
KINDS = ("ros1", "sqlite3", "mcap")


class Bag:
    """Writes messages of either generation: fields by name, stamps in nanoseconds."""

    def __init__(self, kind, folder):
        self.is_ros1 = kind == "ros1"
        self.path = folder / ("in.bag" if self.is_ros1 else "in")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.LATEST)
        if self.is_ros1:
            self.store.register(get_types_from_msg(TF, "tf2_msgs/msg/TFMessage"))
            self.writer = Writer1(self.path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.connections = {}

    def make(self, name, **fields):
        package, _, name = name.partition("/")
        return self.store.types[f"{package}/msg/{name}"](**fields)

    def header(self, ns, frame):
        stamp = self.make("builtin_interfaces/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        sequence = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **sequence)

    def write(self, topic, name, ns, **fields):
        message = self.make(name, **fields)
        if topic not in self.connections:
            kind = message.__msgtype__
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], ns, serialize(message, message.__msgtype__))

    def image(self, topic, ns, frame, encoding, pixels):
        row = np.ascontiguousarray(pixels).view(np.uint8).reshape(HEIGHT, -1)
        row = np.pad(row, ((0, 0), (0, 4)))  # rows may be longer than their pixels
        fields = {"height": HEIGHT, "width": WIDTH, "encoding": encoding, "is_bigendian": 0}
        fields |= {"step": row.shape[1], "data": row.ravel(), "header": self.header(ns, frame)}
        self.write(topic, "sensor_msgs/Image", ns + 5, **fields)  # written a little later

    def info(self, topic, frame, lens=(), width=WIDTH, model="plumb_bob"):
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
                        do_rectify=False)  # fmt: skip
        names = dict(zip("dkrp", "DKRP")) if self.is_ros1 else dict(zip("dkrp", "dkrp"))
        numbers = {"d": np.array(lens), "k": OPENCV_K.ravel(), "r": np.eye(3).ravel()}
        numbers |= {"p": np.hstack([OPENCV_K, np.zeros((3, 1))]).ravel()}
        fields = {names[name]: np.array(value, float) for name, value in numbers.items()}
        fields |= {"height": HEIGHT, "width": width, "distortion_model": model, "roi": roi}
        fields |= {"binning_x": 0, "binning_y": 0, "header": self.header(START_NS, frame)}
        self.write(topic, "sensor_msgs/CameraInfo", START_NS, **fields)

    def transform(self, topic, ns, parent, child, pose):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        place = dict(zip("xyz", pose[:3, 3]))
        transform = self.make(
            "geometry_msgs/Transform",
            translation=self.make("geometry_msgs/Vector3", **place),
            rotation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
        )
        fields = {"header": self.header(ns, parent), "child_frame_id": child}
        stamped = self.make("geometry_msgs/TransformStamped", transform=transform, **fields)
        self.write(topic, "tf2_msgs/TFMessage", ns, transforms=[stamped])


RGB, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth/image_raw"


def stamp(i):
    return START_NS + i * PERIOD_NS


def write(kind, folder, *, static=True, depth="16UC1", late_ns=0, tf=(0, 1, 2), depths=(0, 1, 2)):
    moments = make_moments(unit_m=0.001)
    bag = Bag(kind, folder)
    with bag.writer:
        for camera in ("color", "aligned_depth"):
            bag.info(f"/camera/{camera}/camera_info", "optical")
        if static:
            bag.transform("/tf_static", START_NS, "base", "optical", BASE_FROM_CAM)
        for i, moment in enumerate(moments):
            bag.image(RGB, stamp(i), "optical", "bgr8", moment.rgb[..., ::-1])
            ns, whole = stamp(i) + late_ns, stored(moment.depth, 0.001)
            pixels = {"16UC1": whole, "32FC1": moment.depth}
            if i in depths and depth in pixels:
                bag.image(DEPTH, ns, "optical", depth, pixels[depth])
            elif i in depths:
                if depth.startswith("32FC1"):  # a / z + b, as compressed_depth_image_transport
                    whole = np.rint(60_000 / moment.depth + 100).astype(np.uint16)
                png = struct.pack("<iff", 0, 60_000, 100) + cv2.imencode(".png", whole)[1].tobytes()
                fields = {"format": depth, "data": np.frombuffer(png, np.uint8)}
                fields |= {"header": bag.header(ns, "optical")}
                bag.write(f"{DEPTH}/compressedDepth", "sensor_msgs/CompressedImage", ns, **fields)
            if i in tf:
                base = moment.world_from_cam @ np.linalg.inv(BASE_FROM_CAM)
                bag.transform("/tf", stamp(i), "world", "base", base)
    return bag.path, moments


LENS = (0.2, 0.0, 0.0, 0.0, 0.0)
BESIDE = [("optical", "ir")]


def write_one(folder, *cameras, topic="/color/image", depth=1.0, of="optical", edges=(), x_m=0.0,
              lens=()):  # fmt: skip
    """A picture, what its camera_info says, and its depth in metres, of a frame and a lens.

    Static transforms lead from frame to frame, each x_m to the right.
    """
    rgb, bag, beside = make_moments(unit_m=0.001)[0].rgb, Bag("ros1", folder), np.eye(4)
    beside[0, 3] = x_m
    with bag.writer:
        for camera in cameras or [{}]:
            bag.info(f"{topic.rpartition('/')[0]}/camera_info", "optical", **camera)
        bag.info("/depth/camera_info", of, lens)
        for parent, child in edges:
            bag.transform("/tf_static", START_NS, parent, child, beside)
        bag.image(topic, START_NS, "optical", "rgb8", rgb)
        whole = np.full((HEIGHT, WIDTH), depth, np.float32)
        bag.image("/depth/image", START_NS, of, "32FC1", whole)
    return bag.path, rgb


def assert_is_read(recording, moments, *, poses=True, rtol=1e-6):
    assert len(recording) == len(moments)
    for i, (frame, moment) in enumerate(zip(recording, moments)):
        np.testing.assert_array_equal(frame.rgb, moment.rgb)
        np.testing.assert_allclose(frame.depth, moment.depth, rtol=rtol)
        np.testing.assert_allclose(frame.K, K)
        assert frame.timestamp_s == pytest.approx(stamp(i) * 1e-9)
        if poses:
            np.testing.assert_allclose(frame.world_from_cam, moment.world_from_cam, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "depth", "rtol"),
    [
        ("ros1", "16UC1", 1e-6), ("sqlite3", "32FC1", 0),
        ("mcap", "16UC1; compressedDepth png", 1e-6), ("mcap", "32FC1; compressedDepth png", 1e-4),
    ],
)  # fmt: skip
def test_a_bag_of_either_generation_is_read_and_its_depth_is_metres(kind, depth, rtol, tmp_path):
    path, moments = write(kind, tmp_path, depth=depth, late_ns=7_000_000)
    recording = open_recording(path, "rosbag")
    assert_is_read(recording, moments, rtol=rtol)
    assert recording.has_poses
    assert any("+0.0070 s" in note for note in recording.notes)


def test_a_picture_without_depth_of_its_own_is_left_out(tmp_path):
    # Depth of the first picture is 93 ms from the second, but 7 ms from its own.
    path, _ = write("mcap", tmp_path, late_ns=7_000_000, depths=(0, 2))
    recording = open_recording(path, "rosbag")
    assert [frame.position for frame in recording] == [0, 2]
    assert any(note.startswith("1 of 3") for note in recording.notes)


def test_a_circle_of_tf_frames_is_followed_once(tmp_path):
    path, _ = write_one(tmp_path, of="c", edges=[("optical", "b"), ("b", "optical")])
    with pytest.raises(SequenceError, match=r"depth is of c, pictures of optical.*aligned"):
        open_recording(path, "rosbag")


def test_a_frame_with_two_parents_is_refused(tmp_path):
    # Odometry publishes the base in odom, SLAM in map. Transforms of both would be interpolated.
    moments, bag = make_moments(unit_m=0.001), Bag("ros1", tmp_path)
    with bag.writer:
        bag.info("/camera/color/camera_info", "base")
        for i, moment in enumerate(moments):
            bag.image(RGB, stamp(i), "base", "rgb8", moment.rgb)
            bag.image(DEPTH, stamp(i), "base", "32FC1", moment.depth)
            for late_ns, parent in ((-20_000_000, "map"), (10_000_000, "odom")):
                bag.transform("/tf", stamp(i) + late_ns, parent, "base", moment.world_from_cam)
    with pytest.raises(SequenceError, match="base in map and in odom"):
        open_recording(bag.path, "rosbag")
    assert not open_recording(bag.path, "rosbag", world="base").has_poses


@pytest.mark.parametrize("kind", KINDS[:2])
def test_a_missing_static_transform_is_reported_and_can_be_given(kind, tmp_path):
    path, moments = write(kind, tmp_path, static=False)
    recording = open_recording(path, "rosbag")
    assert_is_read(recording, moments, poses=False)
    assert not recording.has_poses
    assert any("optical" in n and "base" in n and "frame_from_cam" in n for n in recording.notes)
    x, y, z, w = Rotation.from_matrix(BASE_FROM_CAM[:3, :3]).as_quat()
    numbers = [*map(float, BASE_FROM_CAM[:3, 3]), *map(float, (x, y, z, w))]
    given = open_recording(path, "rosbag", frame="base", frame_from_cam=numbers)
    assert_is_read(given, moments)


def test_a_pose_lies_between_the_transforms_around_its_picture(tmp_path):
    path, moments = write("mcap", tmp_path, tf=(0, 2))
    # The base, which tf moves, is half-way; how it turns is tested in test_readers.py.
    poses = moments[0].world_from_cam, open_recording(path, "rosbag")[1].world_from_cam
    poses = np.stack([*poses, moments[2].world_from_cam]) @ np.linalg.inv(BASE_FROM_CAM)
    first, between, last = poses[:, :3, 3]
    np.testing.assert_allclose(between, (first + last) / 2, atol=1e-6)
    few = open_recording(path, "rosbag", tolerance_s=0.05)
    assert len(few) == 2
    assert any(note.startswith("1 of 3") for note in few.notes)


def test_depth_of_another_camera_is_registered(tmp_path):
    # Seen at 1 m, two pixels to the right.
    path, _ = write_one(tmp_path, of="ir", edges=BESIDE, x_m=2 / 31)
    assert np.isnan(open_recording(path, "rosbag")[0].depth[5]).nonzero()[0].tolist() == [0, 1]


def test_the_lens_of_a_depth_camera_is_taken_out_before_registration(tmp_path):
    path, _ = write_one(tmp_path, depth=np.arange(WIDTH) + 1, of="ir", edges=BESIDE, lens=LENS)
    # Column 33, at x = (33 - 18) / 31, is stored at x (1 + 0.2 x²), in column 33.7.
    assert open_recording(path, "rosbag")[0].depth[12, 33] == 34 + 1


@pytest.mark.parametrize(
    ("topic", "model", "is_bent"),
    [
        ("/direct/image_raw", "plumb_bob", True), ("/color/image_rect_color", "plumb_bob", False),
        ("/color/image_rect_color", "omni", False),
    ],
)  # fmt: skip
def test_only_pictures_that_are_called_rectified_keep_their_pixels(topic, model, is_bent, tmp_path):
    path, rgb = write_one(tmp_path, {"lens": LENS, "model": model}, topic=topic)
    assert np.array_equal(open_recording(path, "rosbag")[0].rgb, rgb) != is_bent


@pytest.mark.parametrize(
    ("cameras", "says"),
    [
        ([{"width": 2 * WIDTH}], r"/color/image has .*camera_info"),
        ([{"model": "thin_prism"}], r"in\.bag, /color/camera_info: .* thin_prism;.*rectify"),
        ([{}, {"lens": LENS}], r"/color/camera_info changes"),
    ],
)
def test_a_calibration_that_is_not_that_of_the_pictures_is_refused(cameras, says, tmp_path):
    path, _ = write_one(tmp_path, *cameras)
    with pytest.raises(SequenceError, match=says):
        open_recording(path, "rosbag")[0]


def test_topics_that_could_be_either_are_named(tmp_path):
    bag = Bag("ros1", tmp_path)
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with bag.writer:
        bag.info("/left/camera_info", "optical")
        for topic in ("/left/image", "/right/image"):
            bag.image(topic, START_NS, "optical", "rgb8", pixels)
        bag.image("/left/depth", START_NS, "optical", "16UC1", pixels[..., 0].astype(np.uint16))
    with pytest.raises(SequenceError, match=r"format\.rgb=.*/left/image, /right/image"):
        open_recording(bag.path, "rosbag")
    assert len(open_recording(bag.path, "rosbag", rgb="/left/image")) == 1
    with pytest.raises(SequenceError, match=r"format\.depth=.*/left/depth"):
        open_recording(bag.path, "rosbag", rgb="/left/image", depth="/nothing")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_and_a_pipe_are_named(kind, tmp_path):
    path, _ = write(kind, tmp_path)
    file = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(SequenceError, match="in"):
        list(open_recording(path, "rosbag"))
    os.mkfifo(tmp_path / "pipe.bag")
    with pytest.raises(SequenceError, match="regular"):
        open_recording(tmp_path / "pipe.bag", "rosbag")
