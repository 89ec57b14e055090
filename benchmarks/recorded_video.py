"""Frames per second of `flowrep.factorize` on a recording of 640 x 480, and its memory over time.

`python benchmarks/recorded_video.py` writes a recording of a textured wall, factorises it on one
core (pictures and flow files are written, but no video) and prints where the time goes.
`python benchmarks/recorded_video.py memory` factorises 10,000 small frames and prints the memory in
use along the way.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from flowrep.sequences import EstimatedFlowSource, open_recording, recorded_motion
from flowrep.sequences.job import Job
from flowrep.sequences.output import Output
from flowrep.transforms import DIS

FRAMES = 60
FOCAL_PX, WALL_M = 525.0, 2.5


def write_recording(folder: Path, frames: int, height: int, width: int) -> None:
    """Writes a recording of a camera that moves in front of a wall, as JPEG and 16-bit PNG."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    wall = cv2.resize(noise, (4 * width, 4 * height), interpolation=cv2.INTER_CUBIC)
    focal = FOCAL_PX * width / 640
    poses = []
    for i in range(frames):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * np.sin(i / 9), 0.1 * np.cos(i / 7), 0.3 * np.sin(i / 15)
        poses.append(pose)
        z = WALL_M - pose[2, 3]
        # The texture has `focal / WALL_M` pixels per metre; its middle is at x = y = 0.
        size = z / WALL_M
        left = 2 * width + pose[0, 3] * focal / WALL_M - size * width / 2
        top = 2 * height + pose[1, 3] * focal / WALL_M - size * height / 2
        warp = np.array([[size, 0, left], [0, size, top]])
        seen = cv2.warpAffine(wall, warp, (width, height), flags=cv2.INTER_LINEAR | 16)
        depth = np.full((height, width), round(1000 * z), np.uint16)
        cv2.imwrite(str(folder / f"rgb/{i:05d}.jpg"), seen)
        cv2.imwrite(str(folder / f"depth/{i:05d}.png"), depth)
    lines = [" ".join(map(str, pose.ravel())) + "\n" for pose in poses]
    (folder / "poses.txt").write_text("".join(lines))
    size = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
    camera = size | {"fx": focal, "fy": focal, "first_pixel_centre": 0.5}
    (folder / "intrinsics.json").write_text(json.dumps(camera))


def measure(
    name: str,
    preset: str,
    *,
    check_consistency: bool,
    register: bool = False,
    flow_files: tuple[str, ...] = ("flo",),
) -> None:
    """Prints the frames per second of one job, by CPU time and by wall time."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_recording(folder / "in", FRAMES, 480, 640)
        if register:
            as_seven_scenes(folder / "in")
        stream = open_recording(folder / "in", "sevenscenes" if register else "frames")
        source = EstimatedFlowSource(DIS(preset), check_consistency=check_consistency)
        out = Output(folder / "out", {}, flow_files=flow_files)
        job = Job(stream, source, recorded_motion, out)
        cpu, wall = time.process_time(), time.perf_counter()
        job.run()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(f"{name:<44} {FRAMES / cpu:6.1f} {FRAMES / wall:6.1f}   {job.clock.summary()}")


def as_seven_scenes(folder: Path) -> None:
    """Renames the files of a recording to those of 7-Scenes, whose depth is registered."""
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    for i, pose in enumerate(poses):
        name = folder / f"frame-{i:06d}"
        (folder / f"rgb/{i:05d}.jpg").rename(f"{name}.color.jpg")
        (folder / f"depth/{i:05d}.png").rename(f"{name}.depth.png")
        np.savetxt(f"{name}.pose.txt", pose)


def memory(frames: int = 10_000) -> None:
    """Prints the memory in use while a long recording is processed, including flow files."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_recording(folder / "in", 20, 48, 64)
        lines = (folder / "in/poses.txt").read_text().splitlines()
        for i in range(20, frames):
            for kind, suffix in (("rgb", "jpg"), ("depth", "png")):
                (folder / f"in/{kind}/{i:05d}.{suffix}").symlink_to(
                    folder / f"in/{kind}/{i % 20:05d}.{suffix}"
                )
            lines.append(lines[i % 20])
        (folder / "in/poses.txt").write_text("\n".join(lines))
        out = WatchedOutput(folder / "out", {}, flow_files=(), pictures_every=0)
        source = EstimatedFlowSource(DIS("fast"))
        Job(open_recording(folder / "in", "frames"), source, recorded_motion, out).run()


class WatchedOutput(Output):
    """Prints the memory in use from time to time."""

    def append(self, index, made) -> None:
        super().append(index, made)
        done = len(self.rows)
        if done % 1000 == 0 or done == 100:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            in_use = pages * resource.getpagesize() / 2**20
            print(f"{done:>6} frames: {in_use:7.1f} MiB", flush=True)


def main() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    if sys.argv[1:] == ["memory"]:
        memory()
        return
    print(f"{'640 x 480, one core, no video':<44} {'CPU':>6} {'wall':>6}   frames per second")
    both = {"check_consistency": True}
    one = {"check_consistency": False}
    measure("DIS fast, both directions (the default)", "fast", **both)
    measure("the same, no flow files", "fast", **both, flow_files=())
    measure("depth registered to colour (7-Scenes)", "fast", **both, register=True)
    measure("DIS fast, one direction", "fast", **one)
    measure("DIS medium, one direction", "medium", **one)
    measure("the same, no flow files", "medium", **one, flow_files=())
    measure("DIS medium, both directions", "medium", **both)


if __name__ == "__main__":
    main()
