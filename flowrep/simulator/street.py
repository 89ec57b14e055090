"""A scene as bodies in the simulator, which the camera sees and the vehicle can hit."""

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
from flowrep.scenes.scene import CATEGORIES, CATEGORY_ID, Scene
from flowrep.scenes.vehicle import VehicleState
from flowrep.simulator import meshes
from flowrep.simulator.bullet import Simulator
from flowrep.simulator.meshes import Body, Mesh, gather, person_meshes
from flowrep.simulator.paint import texture

Array = NDArray[Any]
_TWO_LANES_M = 5.0  # narrower roads have no lane marks
_HIDDEN_M = -1000.0  # height of absent bodies, out of reach of camera and vehicle
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
        self.simulator = Simulator(texture())
        self.bodies: list[Body] = []
        self._numbers: list[int] = []  # PyBullet's, of the bodies
        vehicle, count = layout.scene.vehicle, layout.scene.num_pedestrians
        self._vehicle = self.simulator.add_box(vehicle.length_m, vehicle.width_m, vehicle.height_m)
        # A single cylinder serves all people: it is placed wherever the vehicle may touch a person.
        self._person = self.simulator.add_cylinder(pedestrians.RADIUS_M, pedestrians.HEIGHT_M)
        self._boxes: list[tuple[Box, int]] = []  # all that can be hit, each with its body
        self._add_ground(layout)
        self._add_solids([*layout.buildings, *layout.obstacles])
        self._closures = {
            name: self._add_solid([box], meshes.mesh_of(box, both_sides=True))
            for name, box in layout.closures.items()
        }
        parts = [mesh for i in range(count) for mesh in person_meshes(i)]
        for instance, mesh in enumerate(parts, start=1):
            self._add_body(mesh, "pedestrian", instance)
        self.triangles = gather(self.bodies)
        reach_m = math.hypot(vehicle.length_m, vehicle.width_m) / 2
        self._person_reach_m = reach_m + pedestrians.RADIUS_M
        self._owners = np.array([body for _, body in self._boxes], dtype=int)
        self._centres = np.array([(box.x_m, box.y_m) for box, _ in self._boxes]).reshape(-1, 2)
        reaches = [math.hypot(*box.size_m[:2]) / 2 for box, _ in self._boxes]
        self._reaches_m = np.array(reaches) + reach_m

    @classmethod
    def shared(cls, scene: Scene) -> "Street":
        """Returns the street that all envs of this process with this scene share."""
        # A PyBullet client takes 28 MB. The key is pickled, because a scene contains mappings and
        # has no hash.
        key = pickle.dumps(scene)
        street = _STREETS.get(key)
        if street is None:
            street = _STREETS[key] = cls(Layout(scene))
        return street

    def ids_by_number(self) -> NDArray[np.uint8]:
        """Returns class and instance [N, 2] by PyBullet's number; the last row, -1, is the sky."""
        ids = np.zeros((max(self._numbers) + 2, 2), dtype=np.uint8)
        ids[self._numbers] = [(body.semantic, body.instance) for body in self.bodies]
        return ids

    def is_shown(self, closures: tuple[str, ...]) -> NDArray[np.bool_]:
        """Returns which of the bodies are present while the named exits are closed."""
        shown = np.ones(len(self.bodies), dtype=bool)
        for name, body in self._closures.items():
            shown[body] = name in closures
        return shown

    def close_exits(self, closures: tuple[str, ...]) -> None:
        """Places the named closures and hides all others."""
        for name, body in self._closures.items():
            height_m = 0.0 if name in closures else _HIDDEN_M
            self.simulator.place(self._numbers[body], 0.0, 0.0, 0.0, height_m)

    def place_pedestrians(self, poses: Array) -> None:
        """Places people at poses [P, 4], for a picture."""
        transforms = pedestrians.world_from_parts(poses)
        parts = self._numbers[len(self._numbers) - len(transforms) :]  # the bodies added last
        for part, transform in zip(parts, transforms):
            self.simulator.place_at(part, transform)

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
        for pose in poses[is_near, :3].tolist():
            simulator.place(self._person, *pose)
            if simulator.touch(self._vehicle, self._person):
                return "pedestrian"
        self.close_exits(closures)
        is_near = np.hypot(*(self._centres - at).T) <= self._reaches_m
        for body in dict.fromkeys(self._owners[is_near].tolist()):
            if simulator.touch(self._vehicle, self._numbers[body]):
                return CATEGORIES[self.bodies[body].semantic]
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
            if mesh.indices:
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
        boxes_m = [(box.x_m, box.y_m, box.yaw_rad, *box.size_m) for box in boxes]
        body = self._add_body(mesh, boxes[0].category, boxes_m=boxes_m)
        self._boxes += [(box, body) for box in boxes]
        return body

    def _add_body(self, mesh: Mesh, category: str, instance: int = 0, boxes_m: Any = ()) -> int:
        vertices, uvs = np.array(mesh.vertices), np.array(mesh.uvs)
        triangles, semantic = np.array(mesh.indices).reshape(-1, 3), CATEGORY_ID[category]
        self.bodies.append(Body(vertices, triangles, semantic, instance, uvs))
        self._numbers.append(self.simulator.add_body(mesh, boxes_m))
        return len(self.bodies) - 1


_STREETS: WeakValueDictionary[bytes, Street] = WeakValueDictionary()
