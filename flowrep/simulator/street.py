"""A scene as bodies that the camera sees, and as solids that the vehicle can hit."""

import math
import pickle
from collections.abc import Sequence
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.scenes import pedestrians
from flowrep.scenes.layout import Box, Layout
from flowrep.scenes.scene import CATEGORY_ID, Scene
from flowrep.scenes.vehicle import VehicleState
from flowrep.simulator import meshes
from flowrep.simulator.bullet import Simulator
from flowrep.simulator.meshes import Body, Mesh, gather, person_meshes

Array = NDArray[Any]
_TWO_LANES_M = 5.0  # narrower roads have no lane marks
_HIDDEN_M = -1000.0  # height of absent solids, out of the vehicle's reach
_SAFE_CELL_M = 0.25  # side of a cell of `SafeGround`
_BOXES_A_BODY = 16  # PyBullet's limit for one compound shape


class SafeGround:
    """Knows the places where a vehicle is certainly clear of edges, boxes and end zones.

    Elsewhere, and near people, the exact but slower tests of PyBullet and shapely decide.
    """

    def __init__(self, layout: Layout) -> None:
        vehicle = layout.scene.vehicle
        reach = math.hypot(vehicle.length_m, vehicle.width_m) / 2 + _SAFE_CELL_M
        ends = [layout.zones[path.end] for path in layout.scene.paths]
        boxes = [*layout.buildings, *layout.obstacles, *layout.closures.values()]
        unsafe = shapely.union_all([*ends, *(box.footprint for box in boxes)]).buffer(reach)
        self._safe = layout.drivable.buffer(-reach).difference(unsafe)
        shapely.prepare(self._safe)
        self._is_safe: dict[tuple[int, int], bool] = {}  # by cell, of those where one has been

    def __call__(self, x_m: float, y_m: float) -> bool:
        """Returns whether the vehicle's centre is on safe ground."""
        cell = int(x_m // _SAFE_CELL_M), int(y_m // _SAFE_CELL_M)
        is_safe = self._is_safe.get(cell)
        if is_safe is None:
            x, y = ((number + 0.5) * _SAFE_CELL_M for number in cell)
            is_safe = self._is_safe[cell] = bool(shapely.contains_xy(self._safe, x, y))
        return is_safe


class Street:
    """The bodies of one scene, without any state of an episode."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.is_safe = SafeGround(layout)
        self.simulator = Simulator()
        self.bodies: list[Body] = []
        vehicle, sizes = layout.scene.vehicle, layout.scene.pedestrian_sizes.tolist()
        self._vehicle = self.simulator.add_box(vehicle.length_m, vehicle.width_m, vehicle.height_m)
        # One cylinder serves all people of a size: it is placed where the vehicle may touch one.
        radius_m, height_m = pedestrians.RADIUS_M, pedestrians.HEIGHT_M
        cylinders = {
            size: self.simulator.add_cylinder(size * radius_m, size * height_m)
            for size in dict.fromkeys(sizes)
        }
        self._people = [cylinders[size] for size in sizes]
        self._boxes: list[tuple[Box, int]] = []  # all that can be hit, each with its solid
        self._add_ground(layout)
        self._add_solids([*layout.buildings, *layout.obstacles])
        self._closures: dict[str, tuple[int, int]] = {}  # each one's body and solid
        for name, box in layout.closures.items():
            mesh = meshes.mesh_of(box, both_sides=True)
            self._closures[name] = len(self.bodies), self._add_solid([box], mesh)
        parts = [mesh for i, size in enumerate(sizes) for mesh in person_meshes(i, size)]
        for instance, mesh in enumerate(parts, start=1):
            self._add_body(mesh, "pedestrian", instance)
        self.triangles = gather(self.bodies)
        reach_m = math.hypot(vehicle.length_m, vehicle.width_m) / 2
        self._person_reach_m = reach_m + layout.scene.largest_size * radius_m
        self._solids = np.array([solid for _, solid in self._boxes], dtype=int)
        self._category_of = {solid: box.category for box, solid in self._boxes}
        self._centres = np.array([(box.x_m, box.y_m) for box, _ in self._boxes]).reshape(-1, 2)
        reaches = [math.hypot(*box.size_m[:2]) / 2 for box, _ in self._boxes]
        self._reaches_m = np.array(reaches) + reach_m

    @classmethod
    def shared(cls, scene: Scene) -> "Street":
        """Returns the street that all envs of this process with this scene share."""
        # A street takes a second to build. The key is pickled, because a scene contains mappings
        # and has no hash.
        key = pickle.dumps(scene)
        street = _STREETS.get(key)
        if street is None:
            street = _STREETS[key] = cls(Layout(scene))
        return street

    def is_shown(self, closures: tuple[str, ...]) -> NDArray[np.bool_]:
        """Returns which of the bodies are present while the named exits are closed."""
        shown = np.ones(len(self.bodies), dtype=bool)
        for name, (body, _) in self._closures.items():
            shown[body] = name in closures
        return shown

    def is_anyone_near(self, track: Sequence[VehicleState], poses: Array) -> Array:
        """Returns at which of T times a person, at poses [T, P, 4], is within touching distance."""
        centres = np.array([state[:2] for state in track])
        gaps = poses[..., :2] - centres[:, None]
        return ((gaps * gaps).sum(axis=-1) <= self._person_reach_m**2).any(axis=-1)

    def hit(self, state: VehicleState, poses: Array, closures: tuple[str, ...]) -> str:
        """Returns the category of the body that the vehicle overlaps, or ""."""
        simulator, at = self.simulator, state[:2]
        simulator.place(self._vehicle, *state[:3])
        is_near = np.hypot(*(poses[:, :2] - at).T) <= self._person_reach_m
        for i in np.flatnonzero(is_near).tolist():
            simulator.place(self._people[i], *poses[i, :3].tolist())
            if simulator.touch(self._vehicle, self._people[i]):
                return "pedestrian"
        for name, (_, solid) in self._closures.items():
            simulator.place(solid, 0.0, 0.0, 0.0, 0.0 if name in closures else _HIDDEN_M)
        is_near = np.hypot(*(self._centres - at).T) <= self._reaches_m
        for solid in dict.fromkeys(self._solids[is_near].tolist()):
            if simulator.touch(self._vehicle, solid):
                return self._category_of[solid]
        return ""

    def _add_ground(self, layout: Layout) -> None:
        striped = shapely.union_all([area.polygon for area in layout.crosswalks])
        road, crosswalks = Mesh(), Mesh()
        road.ground(layout.drivable.difference(striped), 0.0, "asphalt")
        for name, line in layout.lines.items():
            if layout.roads[name].width_m >= _TWO_LANES_M:
                others = [ground for other, ground in layout.ribbons.items() if other != name]
                road.add(meshes.lane_marks(line, shapely.union_all([*others, striped])))
        for area in layout.crosswalks:
            crosswalks.add(meshes.crosswalk(*area))
        paved = layout.sidewalks
        if layout.terrain.is_empty:
            # The paving continues under the houses, so that no gap opens between them.
            paved = paved.buffer(2.0).difference(layout.drivable)
        paving, grass = Mesh(), Mesh()
        paving.ground(paved, 0.0, "paving")
        paving.add(meshes.kerb(layout.drivable, paved))
        grass.ground(layout.terrain, 0.0, "grass")
        grounds = {"road": road, "crosswalk": crosswalks, "sidewalk": paving, "terrain": grass}
        for category, mesh in grounds.items():
            if len(mesh.triangles[0]):
                self._add_body(mesh, category)

    def _add_solids(self, boxes: list[Box]) -> None:
        for category in dict.fromkeys(box.category for box in boxes):
            solids = [box for box in boxes if box.category == category]
            for first in range(0, len(solids), _BOXES_A_BODY):
                mesh, chunk = Mesh(), solids[first : first + _BOXES_A_BODY]
                for box in chunk:
                    mesh.add(meshes.mesh_of(box))
                self._add_solid(chunk, mesh)

    def _add_solid(self, boxes: list[Box], mesh: Mesh) -> int:
        self._add_body(mesh, boxes[0].category)
        boxes_m = [(box.x_m, box.y_m, box.yaw_rad, *box.size_m) for box in boxes]
        solid = self.simulator.add_boxes(boxes_m)
        self._boxes += [(box, solid) for box in boxes]
        return solid

    def _add_body(self, mesh: Mesh, category: str, instance: int = 0) -> None:
        self.bodies.append(Body(*mesh.triangles, CATEGORY_ID[category], instance))


_STREETS: WeakValueDictionary[bytes, Street] = WeakValueDictionary()
