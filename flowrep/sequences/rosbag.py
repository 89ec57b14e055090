"""Bags of ROS 1 and ROS 2: pictures, depth, calibration and transforms, by their message types."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, cycle, islice, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.extras import require
from flowrep.sequences import calibration, matching
from flowrep.sequences.calibration import Lens, Matrix, as_pose
from flowrep.sequences.files import decoded, regular
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError

# Encodings by their type and channels; of colour, the order in which red, green and blue stand.
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COLOUR = {
    "rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "8UC3": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]), "mono8": (1, [0, 0, 0]),
}  # fmt: skip


class _Edge(NamedTuple):
    """A frame's poses in its parent, at some times, or at any if it is static."""

    parents: set[str]  # of which a tree has one
    is_static: bool
    stamps: list[int]
    poses: list[Pose]


class RosBag(Recording):
    """A bag's colour pictures, each with its nearest depth map and its pose at its own time.

    Topics are found by their messages' types, and a frame's pose by tf and tf_static, from the root
    of the tree to the pictures' optical frame, interpolated. If depth is another camera's, it is
    registered to the pictures.

    Args:
        path: a .bag of ROS 1, or the folder of a ROS 2 bag (SQLite or MCAP) with its metadata.yaml.
        rgb: topic of the pictures; None finds it, as the next two.
        depth: topic of depth: 16UC1 (mm), 32FC1 (m), or compressedDepth of them.
        camera_info: topic of the pictures' calibration, by default beside them.
        world: frame in which poses are given; None is the root of the tree.
        frame: frame of the pictures, if it isn't the one that their header names.
        frame_from_cam: the optical frame's pose in it, if tf_static lacks it: see `fixed_pose`.
        tolerance_s: longest time between a picture and its depth, or a transform.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        rgb: str | None = None,
        depth: str | None = None,
        camera_info: str | None = None,
        world: str | None = None,
        frame: str | None = None,
        frame_from_cam: Sequence[float] | None = None,
        tolerance_s: float = 0.1,
    ) -> None:
        require("format=rosbag", "rosbag", "rosbags")
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self.path, self.tolerance_s = Path(path), tolerance_s
        self._written: dict[tuple[str, int], int] = {}  # when, by topic and stamp
        self._sizes: dict[str, tuple[int, int]] = {}  # of the calibration, by the pictures' topic
        with self._naming():
            source = self.path if self.path.is_dir() else regular(self.path, math.inf)
            older = get_typestore(Stores.LATEST)  # for bags that hold no definitions
            self._reader: Any = AnyReader([source], default_typestore=older)
            self._reader.open()
            self._kinds = {c.topic: c.msgtype.split("/")[-1] for c in self._reader.connections}
            colour, depths = self._pictures()
            self._rgb = self._topic("rgb", rgb, colour)
            self._depth = self._topic("depth", depth, depths)
            stamps, optical = self._index(self._rgb)
            depth_stamps, depth_optical = self._index(self._depth)
            self.K, lens = self._camera(camera_info, self._rgb)
            self._edges = self._transforms()
            fixed = calibration.fixed_pose(frame_from_cam, "frame_from_cam")
            self._choose(stamps, depth_stamps, frame or optical, world, fixed)
            self._K_depth, colour_from_depth = self.K, None
            self._depth_rig = calibration.Rig([], "opencv", None)  # before depth is registered
            if depth_optical != optical:
                self._K_depth, depth_lens = self._camera(None, self._depth)
                self._depth_rig = calibration.Rig(*depth_lens, None)
                colour_from_depth = self._between_cameras(optical, depth_optical)
            self._rig = calibration.Rig(*lens, colour_from_depth)

    @contextmanager
    def _naming(self) -> Iterator[None]:
        try:
            yield
        except (SequenceError, OSError):
            raise
        except Exception as error:  # the library's, whatever broken bytes lead to
            remedy = "give a .bag of ROS 1, or a ROS 2 bag's folder with its metadata.yaml"
            says = f"can't be read as a bag: {' '.join(str(error).split())}"
            raise SequenceError(self.path, f"{says}; {remedy}") from error

    def _choose(
        self, stamps: list[int], depth_stamps: list[int], frame: str, world: str | None, fixed: Pose
    ) -> None:
        """Matches depth and transforms to pictures, and says how well they fit."""
        start = min(stamps[0], depth_stamps[0])
        times_s, depth_times_s = ((np.array(x) - start) * 1e-9 for x in (stamps, depth_stamps))
        (rows, _), _ = matching.match_times(depth_times_s, times_s, self.tolerance_s)
        said = [f"pictures are {self._rgb}, depth {self._depth}"]
        if (rows >= 0).any():
            lag_s = np.median((depth_times_s[rows] - times_s)[rows >= 0])
            said.append(f"depth is {lag_s:+.4f} s from its picture, in the median")
        left_out = {f"without depth within {self.tolerance_s} s": rows < 0}
        poses: Any = [None] * len(times_s)
        edges = self._edges_above(frame, world)
        self.has_poses = any(not edge.is_static for edge in edges)
        if self.has_poses:
            poses, gap_s = self._poses(edges, times_s, start, fixed)
            lacking = np.isnan(poses).any((1, 2))
            left_out[f"without transforms within {self.tolerance_s} s"] = lacking
            said.append(f"poses are interpolated between transforms up to {gap_s:.3f} s apart")
        else:
            there = ", ".join(sorted(self._edges)) or "nothing"
            remedy = "give format.frame= and format.frame_from_cam=, or poses are estimated"
            said.append(f"no transform moves {frame} (tf has those of {there}): {remedy}")
        remedy = "raise format.tolerance_s, or give another format.world"
        kept, notes = matching.keep([*map(_name, stamps)], left_out, self.path, remedy)
        places = matching.positions(times_s)
        # The stamps of a picture and its depth, its pose, its number if no frame were missing.
        self._moments = [(stamps[i], depth_stamps[rows[i]], poses[i], int(places[i])) for i in kept]
        self.count, self.notes = len(kept), (*said, *notes)

    # Which topics there are.

    def _pictures(self) -> tuple[list[str], list[str]]:
        """Returns the topics of colour pictures and those of depth."""
        colour, depth = [], []
        for topic in self._of_kind("Image", "CompressedImage"):
            for _, first in islice(self._messages(topic), 1):
                encoding = getattr(first, "encoding", None) or first.format
                if encoding in _DEPTH or "compressedDepth" in encoding:
                    depth.append(topic)
                elif encoding in _COLOUR or not hasattr(first, "encoding"):
                    colour.append(topic)
        return colour, depth

    def _of_kind(self, *kinds: str) -> list[str]:
        return sorted(topic for topic, kind in self._kinds.items() if kind in kinds)

    def _topic(self, option: str, given: str | None, there: list[str]) -> str:
        if given is not None and given in there:
            return given
        # A topic and its compressed copy beneath it are one.
        apart = [topic for topic in there if topic.rpartition("/")[0] not in there]
        if given is None and len(apart) == 1:
            return apart[0]
        says = f"has no {option} topic {given}" if given else f"has {len(apart)} {option} topics"
        listing = ", ".join(there or sorted(self._kinds))
        raise SequenceError(self.path, f"{says}: give format.{option}=<topic>; it has {listing}")

    def _messages(self, topic: str, *times: int) -> Iterator[tuple[int, Any]]:
        """Yields when a topic's messages were written, and the messages."""
        connections = [c for c in self._reader.connections if c.topic == topic]
        for connection, written, data in self._reader.messages(connections, *times):
            yield written, self._reader.deserialize(data, connection.msgtype)

    def _index(self, topic: str) -> tuple[list[int], str]:
        """Returns the stamps (ns) of a topic's messages in their order, and its frame."""
        frame = ""
        for written, message in self._messages(topic):
            self._written[topic, _ns(message.header.stamp)] = written
            frame = message.header.frame_id.lstrip("/")
        return sorted(ns for name, ns in self._written if name == topic), frame

    def _image(self, topic: str, stamp: int) -> Any:
        written = self._written[topic, stamp]
        messages = self._messages(topic, written, written + 1)
        return next(m for _, m in messages if _ns(m.header.stamp) == stamp)

    def _camera(self, given: str | None, topic: str) -> tuple[Matrix, tuple[Sequence[float], Lens]]:
        """Returns K of a topic's pictures, and the distortion and formula of their lens."""
        there = self._of_kind("CameraInfo")
        beside = [f"{topic.rsplit('/', levels)[0]}/camera_info" for levels in (1, 2)]
        named = next((name for name in beside if name in there), None) if given is None else given
        source = self._topic("camera_info", named, there)
        _, info = next(self._messages(source))
        size = self._sizes[topic] = info.height, info.width
        names = ("K", "D", "P") if hasattr(info, "K") else ("k", "d", "p")
        numbers = (getattr(each, name) for _, each in self._messages(source) for name in names)
        K, D, P = first = tuple(islice(numbers, 3))
        if not all(map(np.array_equal, numbers, cycle(first))):
            raise SequenceError(self.path, f"{source} changes during the bag: cut it there")
        # ROS's name for pictures without distortion, of P, as in image_rect_color.
        if re.search("[/_]rect", topic):
            return calibration.camera_matrix(P, size, 0.0, source), ([], "opencv")
        lens = calibration.lens_of(info.distortion_model or "none", f"{self.path}, {source}")
        distortion = [*D] if np.any(D) else []
        return calibration.camera_matrix(K, size, 0.0, source), (distortion, lens)

    # Where the camera was.

    def _transforms(self) -> dict[str, _Edge]:
        edges: dict[str, _Edge] = {}
        for topic in self._of_kind("TFMessage"):
            sent = (message.transforms for _, message in self._messages(topic))
            for each in chain.from_iterable(sent):
                t, q = each.transform.translation, each.transform.rotation
                numbers = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
                parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
                edge = edges.setdefault(child, _Edge(set(), topic.endswith("static"), [], []))
                edge.parents.add(parent)
                edge.stamps.append(_ns(each.header.stamp))
                edge.poses.append(as_pose(numbers, topic, layout="xyz_xyzw"))
        return edges

    def _edges_above(self, frame: str, root: str | None) -> list[_Edge]:
        """Returns the edges from a frame up to the root."""
        edges: list[_Edge] = []
        while frame != root and frame in self._edges and len(edges) <= len(self._edges):
            edges.append(self._edges[frame])
            parents = sorted(edges[-1].parents)
            if len(parents) > 1:
                says = f"tf has {frame} in {' and in '.join(parents)}, so its poses are mixed"
                raise SequenceError(self.path, f"{says}: cut one out of the bag")
            frame = parents[0]
        if root is not None and frame != root:
            found = set[str]().union(*(edge.parents for edge in self._edges.values()))
            there = ", ".join(sorted(found)) or "nothing"
            raise SequenceError(self.path, f"tf doesn't lead to {root}, but to {there}")
        return edges

    def _poses(
        self, edges: list[_Edge], times_s: NDArray[np.float64], start: int, fixed: Pose
    ) -> tuple[NDArray[np.float64], float]:
        """Returns world_from_cam, nan where it is unknown, and the longest gap bridged."""
        poses, gap_s = np.stack([fixed] * len(times_s)), 0.0
        for edge in edges:
            if edge.is_static:  # if it was sent again, the last counts
                poses = edge.poses[-1] @ poses
                continue
            order = np.argsort(edge.stamps, kind="stable")
            at_s = (np.array(edge.stamps)[order] - start) * 1e-9
            rows, share = matching.match_times(at_s, times_s, self.tolerance_s, interpolate=True)
            gap_s = max(gap_s, float(np.ptp(at_s[rows], axis=0)[rows[0] >= 0].max(initial=0.0)))
            poses = matching.poses_between(np.array(edge.poses)[order], rows, share) @ poses
            poses[rows[0] < 0] = np.nan
        return poses, gap_s

    def _between_cameras(self, colour: str, depth: str) -> Pose:
        """Returns colour_from_depth, of two optical frames that static transforms connect."""
        ends, bases = [], set()
        for frame in (colour, depth):
            pose = np.eye(4)
            for edge in takewhile(lambda edge: edge.is_static, self._edges_above(frame, None)):
                pose, frame = edge.poses[-1] @ pose, min(edge.parents)
            ends.append(pose)
            bases.add(frame)
        if len(bases) > 1:
            remedy = "record tf_static, or depth aligned to colour (aligned_depth_to_color)"
            raise SequenceError(self.path, f"depth is of {depth}, pictures of {colour}: {remedy}")
        return np.linalg.inv(ends[0]) @ ends[1]

    def _frame(self, index: int) -> Frame:
        stamp, depth_stamp, pose, position = self._moments[index]
        with self._naming():
            rgb: Any = _colour(self._image(self._rgb, stamp), self.path)
            depth: Any = _metres(self._image(self._depth, depth_stamp), self.path)
        for topic, size in ((self._rgb, rgb.shape[:2]), (self._depth, depth.shape)):
            if (of_K := self._sizes.get(topic, size)) not in (size, (0, 0)):
                says = f"has {list(size)} rows and columns, its camera_info says {list(of_K)}"
                raise SequenceError(self.path, f"{topic} {says}: give format.camera_info=")
        _, depth = self._depth_rig(None, depth, self._K_depth, self._K_depth)
        rgb, depth = self._rig(rgb, depth, self.K, self._K_depth)
        options: Any = {"timestamp_s": stamp * 1e-9, "position": position}
        return Frame(_name(stamp), self.path, pose, self.K, depth, rgb, **options)


def _name(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _plane(message: Any, dtype: str, channels: int) -> NDArray[Any]:
    order = ">" if message.is_bigendian else "<"
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    width = message.width * channels * np.dtype(dtype).itemsize
    pixels = np.ascontiguousarray(rows[:, :width]).view(order + dtype)
    return pixels.reshape(message.height, message.width, channels)


def _colour(message: Any, path: Path) -> NDArray[np.uint8]:
    if hasattr(message, "encoding"):
        channels, order = _COLOUR[message.encoding]
        return np.ascontiguousarray(_plane(message, "u1", channels)[..., order])
    picture = decoded(path, bytes(message.data))
    return picture[..., :3] if picture.ndim == 3 else np.stack(3 * [picture], -1)


def _metres(message: Any, path: Path) -> NDArray[np.float32]:
    """Returns depth in metres; 0 and what isn't finite is missing (REP 118)."""
    if hasattr(message, "encoding"):
        stored: Any = _plane(message, _DEPTH[message.encoding], 1)[..., 0]
    else:  # compressed_depth_image_transport: 12 bytes, then a PNG
        data = bytes(message.data)
        stored = decoded(path, data[12:])
        if message.format.startswith("32FC1"):  # a / depth + b
            _, a, b = struct.unpack_from("<iff", data)
            stored = np.where(stored == 0, np.nan, a / (stored - np.float32(b)))
    unit_m = 0.001 if stored.dtype.kind == "u" else 1.0
    depth: NDArray[np.float32] = (stored * np.float64(unit_m)).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
