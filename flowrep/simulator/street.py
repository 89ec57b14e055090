"""A laid-out scene as bodies in the simulator, visible to the camera and solid to the vehicle."""

import math
import pickle
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.palette import CATEGORY_ID
from flowrep.scenes import pedestrians
from flowrep.scenes.layout import Box, Layout
from flowrep.scenes.scene import Scene, VehicleState
from flowrep.simulator import meshes
from flowrep.simulator.bullet import Simulator
from flowrep.simulator.meshes import Body, gather, person_meshes
from flowrep.simulator.paint import texture

Array = NDArray[Any]
_BEHIND_M = 2.0  # people further behind the camera are out of view: none reach that far
_TWO_LANES_M = 5.0  # narrower roads have no lane marks
_TRIANGLES_A_BODY = 43_690  # PyBullet's limit for one mesh is 131,072 vertices
_SAFE_CELL_M = 0.25
_BOXES_A_BODY = 16  # PyBullet's limit for one compound shape


class SafeGround:
    """A fast, conservative test that a vehicle is on the road, clear of boxes and ending zones.

    Where it returns False, exact tests decide. It does not consider people.
    """

    def __init__(self, layout: Layout) -> None:
        """Marks the cells that are safe for any vehicle position and heading in them."""
        vehicle = layout.scene.vehicle
        reach = math.hypot(vehicle.length_m, vehicle.width_m) / 2 + _SAFE_CELL_M
        ends = [layout.zones[path.end] for path in layout.scene.paths]
        boxes = [*layout.buildings, *layout.obstacles, *layout.closures.values()]
        unsafe = shapely.union_all([*ends, *(box.footprint for box in boxes)]).buffer(reach)
        safe = layout.drivable.buffer(-reach).difference(unsafe)
        self._x0, self._y0, x1, y1 = layout.drivable.bounds
        x = np.arange(self._x0, x1, _SAFE_CELL_M) + _SAFE_CELL_M / 2
        y = np.arange(self._y0, y1, _SAFE_CELL_M) + _SAFE_CELL_M / 2
        shapely.prepare(safe)
        table = shapely.contains_xy(safe, *np.meshgrid(x, y, indexing="ij"))
        self._columns = [column.astype(np.uint8).tobytes() for column in table]
        self._rows = len(y)

    def __call__(self, x_m: float, y_m: float) -> bool:
        """Returns whether the vehicle's centre is on safe ground."""
        i, j = int((x_m - self._x0) // _SAFE_CELL_M), int((y_m - self._y0) // _SAFE_CELL_M)
        is_on_table = 0 <= i < len(self._columns) and 0 <= j < self._rows
        return is_on_table and self._columns[i][j] == 1


class Solid(NamedTuple):
    """Static boxes that form one body."""

    body: int
    category: str
    boxes: tuple[Box, ...]
    number: int  # index in `Street.bodies`


class Solids(NamedTuple):
    """The boxes that can be hit, and the bodies present, for one set of closed exits."""

    owners: tuple[Solid, ...]
    centres: Array  # [B, 2]
    reaches_m: Array  # [B], distance from a box within which the vehicle may touch it
    is_shown: Array  # for each of `Street.bodies`


class Street:
    """The bodies of one scene, shared by all environments of a process with that scene.

    It holds no state of an episode: callers pass the poses of the vehicle and of everyone else, and
    the closed exits. Environments share one because a PyBullet client takes 28 MB.
    """

    def __init__(self, layout: Layout) -> None:
        """Builds every body of the scene in a simulator."""
        self.layout = layout
        self.is_safe = SafeGround(layout)
        self.lock = threading.RLock()  # held from placing bodies to rendering them
        self.users = 0
        self.simulator = Simulator(texture())
        self.bodies: list[Body] = []
        vehicle = layout.scene.vehicle
        self.simulator.add_vehicle(vehicle.length_m, vehicle.width_m, vehicle.height_m)
        self._vehicle_reach_m = math.hypot(vehicle.length_m, vehicle.width_m) / 2
        self._person_reach_m = self._vehicle_reach_m + pedestrians.RADIUS_M
        self._person = self.simulator.add_cylinder(pedestrians.RADIUS_M, pedestrians.HEIGHT_M)
        self._solids: list[Solid] = []
        self._add_ground(layout)
        self._add_solids(layout)
        self._closures = {name: self._add_closure(box) for name, box in layout.closures.items()}
        count = layout.scene.num_pedestrians
        meshes_of_all = [mesh for i in range(count) for mesh in person_meshes(i)]
        parts = [
            self._add_body(mesh, "pedestrian", instance=number)
            for number, mesh in enumerate(meshes_of_all, start=1)
        ]
        self._parts = np.array(parts, dtype=int).reshape(count, len(pedestrians.PARTS))
        self._placed = np.full((count, 4), np.nan)  # where everyone's parts were last placed
        self.triangles = gather(self.bodies)
        self._solids_while_closed: dict[tuple[str, ...], Solids] = {}
        self._closed: tuple[str, ...] | None = None
        self.close_exits(())

    @classmethod
    def shared(cls, scene: Scene) -> "Street":
        """Returns the street shared by all open environments of the process with this scene."""
        key = pickle.dumps(scene)
        street = _STREETS.get(key)
        if street is None:
            street = _STREETS[key] = cls(Layout(scene))
        street.users += 1
        return street

    def leave(self) -> None:
        """Disconnects the simulator's client when the last environment that shares it leaves."""
        self.users -= 1
        if self.users == 0:
            self.simulator.close()
            for key in [key for key, street in _STREETS.items() if street is self]:
                del _STREETS[key]

    def solids(self, closures: tuple[str, ...]) -> Solids:
        """Returns the boxes that can be hit and the bodies shown with the named closures."""
        if closures not in self._solids_while_closed:
            solids = [*self._solids, *(self._closures[name] for name in closures)]
            boxes = [box for solid in solids for box in solid.boxes]
            reaches = [math.hypot(*box.size_m[:2]) / 2 for box in boxes]
            is_shown = np.ones(len(self.bodies), dtype=bool)
            for name, solid in self._closures.items():
                is_shown[solid.number] = name in closures
            self._solids_while_closed[closures] = Solids(
                tuple(solid for solid in solids for _ in solid.boxes),
                np.array([(box.x_m, box.y_m) for box in boxes]).reshape(-1, 2),
                np.array(reaches) + self._vehicle_reach_m,
                is_shown,
            )
        return self._solids_while_closed[closures]

    def close_exits(self, closures: tuple[str, ...]) -> None:
        """Places the named closures and hides all others."""
        if closures == self._closed:
            return
        for name, solid in self._closures.items():
            if name in closures:
                self.simulator.place(solid.body, 0.0, 0.0, 0.0)
            else:
                self.simulator.hide(solid.body)
        self._closed = closures

    def place_pedestrians(self, poses: Array, viewer: VehicleState) -> None:
        """Places people at poses [P, 4] who have moved and are, or were last placed, in view."""
        depths = self._depths(np.stack([poses, self._placed]), viewer)
        is_behind = (depths < -_BEHIND_M).all(axis=0)
        due = np.flatnonzero((poses != self._placed).any(axis=-1) & ~is_behind)
        if due.size:
            places = pedestrians.place_parts(poses[due])
            self.simulator.place_all(
                self._parts[due].ravel().tolist(),
                places.positions.reshape(-1, 3),
                places.quaternions_xyzw.reshape(-1, 4),
            )
            self._placed[due] = poses[due]

    def is_anyone_near(self, track: Sequence[VehicleState], poses: Array) -> Array:
        """Returns at which times someone is near enough to be touched [T].

        Args:
            track: states of the vehicle at T times.
            poses: everyone's poses [T, P, 4] at those times.
        """
        centres = np.array([state[:2] for state in track])
        gaps = poses[..., :2] - centres[:, None]
        return ((gaps * gaps).sum(axis=-1) <= self._person_reach_m**2).any(axis=-1)

    def hit(self, state: VehicleState, poses: Array, closures: tuple[str, ...]) -> str:
        """Returns the category of the body that the vehicle overlaps, or "".

        Only bodies near enough to be touched are passed to PyBullet's collision test.

        Args:
            state: the vehicle's state.
            poses: everyone's poses [P, 4].
            closures: names of the closures in place.
        """
        gaps = np.hypot(poses[:, 0] - state.x_m, poses[:, 1] - state.y_m)
        people_near = np.flatnonzero(gaps <= self._person_reach_m).tolist()
        solids = self.solids(closures)
        gaps = np.hypot(solids.centres[:, 0] - state.x_m, solids.centres[:, 1] - state.y_m)
        owners = (solids.owners[i] for i in np.flatnonzero(gaps <= solids.reaches_m).tolist())
        near = {solid.body: solid.category for solid in owners}
        with self.lock:
            self.close_exits(closures)
            self.simulator.place_vehicle(state.x_m, state.y_m, state.yaw_rad)
            for i in people_near:
                self.simulator.place(self._person, *poses[i, :3].tolist())
                if self.simulator.vehicle_touches(self._person):
                    return "pedestrian"
            touched = (name for body, name in near.items() if self.simulator.vehicle_touches(body))
            return next(touched, "")

    def _depths(self, poses: Array, viewer: VehicleState) -> Array:
        """Returns the depths [...] of the middles of people at poses [..., 4], for the camera."""
        camera = self.layout.scene.camera
        pitch = math.radians(camera.pitch_deg)
        x, y = math.cos(viewer.yaw_rad), math.sin(viewer.yaw_rad)
        at = viewer.x_m * x + viewer.y_m * y + camera.mount_forward_m
        above_m = pedestrians.HEIGHT_M / 2 - camera.mount_height_m
        forward_m = poses[..., 0] * x + poses[..., 1] * y - at
        return math.cos(pitch) * forward_m + math.sin(pitch) * above_m

    def _add_ground(self, layout: Layout) -> None:
        striped = shapely.union_all([area.polygon for area in layout.crosswalks])
        road, crosswalks = meshes.Mesh(), meshes.Mesh()
        road.ground(layout.drivable.difference(striped), 0.0, "asphalt")
        for name in layout.lines:
            road.add(self._lane_marks(layout, name, striped))
        for area in layout.crosswalks:
            crosswalks.add(meshes.crosswalk(*area))
        paved = layout.sidewalks
        if layout.terrain.is_empty:
            # The paving continues under the houses, so that no gap opens between them.
            paved = paved.buffer(2.0).difference(layout.drivable)
        paving, grass = meshes.Mesh(), meshes.Mesh()
        paving.ground(paved, 0.0, "paving")
        paving.add(meshes.kerb(layout.drivable, paved))
        grass.ground(layout.terrain, 0.0, "grass")
        for mesh, category in (
            (road, "road"),
            (crosswalks, "crosswalk"),
            (paving, "sidewalk"),
            (grass, "terrain"),
        ):
            for part in mesh.parts(_TRIANGLES_A_BODY):
                self._add_body(part, category)

    def _lane_marks(self, layout: Layout, name: str, striped: BaseGeometry) -> meshes.Mesh:
        if layout.width_m(name) < _TWO_LANES_M:
            return meshes.Mesh()
        others = [ground for other, ground in layout.ribbons.items() if other != name]
        return meshes.lane_marks(layout.lines[name], shapely.union_all([*others, striped]))

    def _add_solids(self, layout: Layout) -> None:
        by_category: dict[str, list[Box]] = {}
        for box in (*layout.buildings, *layout.obstacles):
            by_category.setdefault(box.category, []).append(box)
        for category, boxes in by_category.items():
            for first in range(0, len(boxes), _BOXES_A_BODY):
                mesh, chunk = meshes.Mesh(), boxes[first : first + _BOXES_A_BODY]
                for box in chunk:
                    mesh.add(meshes.mesh_of(box))
                self._solids.append(self._add_solid(mesh, category, chunk))

    def _add_closure(self, box: Box) -> Solid:
        return self._add_solid(meshes.mesh_of(box, both_sides=True), box.category, [box])

    def _add_solid(self, mesh: meshes.Mesh, category: str, boxes: list[Box]) -> Solid:
        body = self._add_body(
            mesh,
            category,
            boxes_m=tuple((box.x_m, box.y_m, box.yaw_rad, *box.size_m) for box in boxes),
        )
        return Solid(body, category, tuple(boxes), len(self.bodies) - 1)

    def _add_body(
        self, mesh: meshes.Mesh, category: str, *, instance: int = 0, **options: Any
    ) -> int:
        vertices = np.array(mesh.vertices, dtype=np.float64)
        triangles = np.array(mesh.indices).reshape(-1, 3)
        seen_as = CATEGORY_ID[category], instance
        uvs = np.array(mesh.uvs).reshape(-1, 2)
        self.bodies.append(Body(vertices, triangles, *seen_as, moves=instance > 0, uvs=uvs))
        return self.simulator.add_body(mesh, category, instance=instance, **options)


_STREETS: WeakValueDictionary[bytes, Street] = WeakValueDictionary()
