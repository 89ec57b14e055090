"""A laid-out scene as bodies in the simulator: what the camera sees and the vehicle can hit."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.envs import meshes, paint
from flowrep.envs.layout import Box, Layout
from flowrep.envs.simulator import Simulator
from flowrep.envs.vehicle import VehicleState

Array = NDArray[Any]
_BOXES_A_BODY = 16  # PyBullet's limit for one compound shape


class Solid(NamedTuple):
    """Boxes that stand still and are one body."""

    body: int
    category: str
    boxes: tuple[Box, ...]


class Street:
    """The bodies of one scene. Closures start hidden, pedestrians at the origin."""

    def __init__(self, layout: Layout) -> None:
        """Builds every body of the scene in a simulator of its own."""
        self.simulator = Simulator(paint.picture())
        vehicle = layout.scene.vehicle
        self.simulator.add_vehicle(vehicle.length_m, vehicle.width_m, vehicle.height_m)
        self._vehicle_reach_m = math.hypot(vehicle.length_m, vehicle.width_m) / 2
        self._person_reach_m = self._vehicle_reach_m + meshes.PEDESTRIAN_RADIUS_M
        self._solids: list[Solid] = []
        self._add_ground(layout)
        self._add_solids(layout)
        self._closures = {name: self._add_closure(box) for name, box in layout.closures.items()}
        self._pedestrians = [
            self.simulator.add_body(
                meshes.pedestrian_mesh(i),
                "pedestrian",
                instance=i + 1,
                cylinder_m=(meshes.PEDESTRIAN_RADIUS_M, meshes.PEDESTRIAN_HEIGHT_M),
            )
            for i in range(layout.scene.num_pedestrians)
        ]
        self.close_exits(())

    def close_exits(self, names: Iterable[str]) -> None:
        """Puts up the closures that are named and takes away all others."""
        self._closed = [name for name in self._closures if name in set(names)]
        for name, solid in self._closures.items():
            if name in self._closed:
                self.simulator.place(solid.body, 0.0, 0.0, 0.0)
            else:
                self.simulator.hide(solid.body)
        solids = [*self._solids, *(self._closures[name] for name in self._closed)]
        self._owners = [solid for solid in solids for _ in solid.boxes]
        boxes = [box for solid in solids for box in solid.boxes]
        self._centres = np.array([(box.x_m, box.y_m) for box in boxes]).reshape(-1, 2)
        reaches = [math.hypot(*box.size_m[:2]) / 2 for box in boxes]
        self._reaches = np.array(reaches) + self._vehicle_reach_m

    def place_pedestrians(self, poses: Array) -> None:
        """Puts everyone at their planar pose [P, 3]."""
        self.simulator.place_all(self._pedestrians, poses)

    def is_anyone_near(self, track: Sequence[VehicleState], poses: Array) -> Array:
        """Returns when someone is near enough to be touched [T].

        Args:
            track: where the vehicle is, T times.
            poses: where everyone is then, planar poses [T, P, 3].
        """
        centres = np.array([state[:2] for state in track])
        gaps = poses[..., :2] - centres[:, None]
        return ((gaps * gaps).sum(axis=-1) <= self._person_reach_m**2).any(axis=-1)

    def _boxes_near(self, state: VehicleState) -> Array:
        gaps = np.hypot(self._centres[:, 0] - state.x_m, self._centres[:, 1] - state.y_m)
        return gaps <= self._reaches

    def hit(self, state: VehicleState, poses: Array) -> str:
        """Returns the category of what the vehicle overlaps, or "".

        Only what is near enough to be touched is put before the simulator's collision oracle.

        Args:
            state: where the vehicle is.
            poses: where everyone is, planar poses [P, 3].
        """
        near = []
        gaps = np.hypot(poses[:, 0] - state.x_m, poses[:, 1] - state.y_m)
        for i in np.flatnonzero(gaps <= self._person_reach_m).tolist():
            self.simulator.place(self._pedestrians[i], *poses[i].tolist())
            near.append((self._pedestrians[i], "pedestrian"))
        owners = (self._owners[i] for i in np.flatnonzero(self._boxes_near(state)).tolist())
        near += {solid.body: solid.category for solid in owners}.items()
        if not near:
            return ""
        self.simulator.place_vehicle(state.x_m, state.y_m, state.yaw_rad)
        return next((name for body, name in near if self.simulator.vehicle_touches(body)), "")

    def _add_ground(self, layout: Layout) -> None:
        road = meshes.Mesh()
        striped = shapely.union_all([area.polygon for area in layout.crosswalks])
        road.ground(layout.drivable.difference(striped), 0.0, "asphalt")
        for line in layout.lines.values():
            road.add(meshes.lane_marks(line))
        self.simulator.add_body(road, "road")
        for ground, colour, category in (
            (striped, "lane_mark", "crosswalk"),
            (layout.terrain, "grass", "terrain"),
        ):
            if not ground.is_empty:
                mesh = meshes.Mesh()
                mesh.ground(ground, 0.0, colour)
                self.simulator.add_body(mesh, category)
        if not layout.sidewalks.is_empty:
            paved = layout.sidewalks
            if layout.terrain.is_empty:
                # The paving runs on under the houses, so that no gap opens between them.
                paved = paved.buffer(2.0).difference(layout.drivable)
            paving = meshes.Mesh()
            paving.ground(paved, 0.0, "paving")
            self.simulator.add_body(paving, "sidewalk")

    def _add_solids(self, layout: Layout) -> None:
        by_category: dict[str, list[Box]] = {}
        for box in (*layout.buildings, *layout.obstacles):
            by_category.setdefault(box.category, []).append(box)
        for category, boxes in by_category.items():
            for first in range(0, len(boxes), _BOXES_A_BODY):
                mesh, chunk = meshes.Mesh(), boxes[first : first + _BOXES_A_BODY]
                for box in chunk:
                    is_house = box.kind == "house"
                    mesh.add(meshes.house_mesh(box) if is_house else meshes.obstacle_mesh(box))
                self._solids.append(self._add_solid(mesh, category, chunk))

    def _add_closure(self, box: Box) -> Solid:
        return self._add_solid(meshes.house_mesh(box, both_sides=True), box.category, [box])

    def _add_solid(self, mesh: meshes.Mesh, category: str, boxes: list[Box]) -> Solid:
        body = self.simulator.add_body(
            mesh,
            category,
            boxes_m=tuple((box.x_m, box.y_m, box.yaw_rad, *box.size_m) for box in boxes),
        )
        return Solid(body, category, tuple(boxes))
