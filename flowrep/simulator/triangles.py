"""Rigid bodies as flat arrays of triangles, in chunks that can be culled as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_CHUNK_TRIANGLES = 24


@dataclass(frozen=True)
class Body:
    """A rigid body.

    Args:
        vertices: [V, 3], metres, in the body's own frame.
        triangles: [T, 3], indices of vertices, counter-clockwise seen from outside.
        semantic: its id in the semantic map.
        instance: its id in the instance map.
        moves: whether it has a pose of its own; if not, its frame is the world's.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    semantic: int
    instance: int
    moves: bool = False


class Triangles(NamedTuple):
    """All bodies, in C chunks, as arrays for the rasteriser."""

    points: NDArray[np.float64]  # [V, 3], in the frames of their bodies
    corners: NDArray[np.int32]  # [T, 3], indices of a chunk's own points
    point_bounds: NDArray[np.int32]  # [C + 1], chunk c has the points from entry c to c + 1
    corner_bounds: NDArray[np.int32]  # [C + 1], the same for triangles
    centres: NDArray[np.float64]  # [C, 3], of the chunks' bounding spheres
    radii: NDArray[np.float64]  # [C]
    bodies: NDArray[np.int32]  # [C], the body of each chunk
    poses: NDArray[np.int32]  # [C], index among the moving bodies; -1 for the static world
    semantic: NDArray[np.uint8]  # [B], by body
    instance: NDArray[np.uint8]  # [B]


def gather(bodies: Sequence[Body]) -> Triangles:
    """Returns the triangles of all bodies, numbered in the given order."""
    points: list[NDArray[np.float64]] = [np.empty((0, 3))]
    corners: list[NDArray[np.int32]] = [np.empty((0, 3), dtype=np.int32)]
    owners: list[int] = []
    poses: list[int] = []
    movers = iter(range(len(bodies)))
    for number, body in enumerate(bodies):
        pose = next(movers) if body.moves else -1
        for chunk in _chunks(body.vertices[body.triangles]):
            own, inverse = np.unique(chunk.reshape(-1, 3), axis=0, return_inverse=True)
            points.append(own)
            corners.append(inverse.reshape(-1, 3).astype(np.int32))
            owners.append(number)
            poses.append(pose)
    spheres = [_sphere(own) for own in points[1:]]
    return Triangles(
        points=np.concatenate(points),
        corners=np.concatenate(corners),
        point_bounds=_bounds(points[1:]),
        corner_bounds=_bounds(corners[1:]),
        centres=np.array([centre for centre, _ in spheres]).reshape(-1, 3),
        radii=np.array([radius for _, radius in spheres], dtype=np.float64),
        bodies=np.array(owners, dtype=np.int32),
        poses=np.array(poses, dtype=np.int32),
        semantic=np.array([body.semantic for body in bodies], dtype=np.uint8),
        instance=np.array([body.instance for body in bodies], dtype=np.uint8),
    )


def _chunks(triangles: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Returns triangles [T, 3, 3] in groups of neighbours."""
    if len(triangles) == 0:
        return []
    if len(triangles) <= _CHUNK_TRIANGLES:
        return [triangles]
    middles = triangles.mean(axis=1)
    longest = int(np.ptp(middles, axis=0).argmax())
    order = np.argsort(middles[:, longest], kind="stable")
    half = len(order) // 2
    return [*_chunks(triangles[order[:half]]), *_chunks(triangles[order[half:]])]


def _sphere(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _bounds(arrays: Sequence[NDArray]) -> NDArray[np.int32]:
    return np.cumsum([0, *(len(array) for array in arrays)]).astype(np.int32)
