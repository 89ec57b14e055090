"""What a scene is: frozen data whose field names are the YAML's keys."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from flowrep.envs.camera import CameraConfig
from flowrep.envs.vehicle import VehicleConfig

SpeedMode = Literal["low", "normal", "high"]
Kind = Literal["house", "tree", "fence", "car", "traffic_light", "lamp_post"]
Point = tuple[float, float]
Range = tuple[float, float]

CATEGORY_OF_KIND: dict[Kind, str] = {
    "house": "building",
    "tree": "tree",
    "fence": "fence",
    "car": "car",
    "traffic_light": "traffic_light",
    "lamp_post": "building",
}
"""The class in the semantic map of what stands in a street; there is none for lamp posts alone."""


@dataclass(frozen=True)
class Piece:
    """One stretch of centreline: straight, or an arc (positive degrees turn left)."""

    straight_m: float | None = None
    arc_radius_m: float | None = None
    arc_deg: float | None = None


@dataclass(frozen=True)
class Road:
    """A drivable ribbon along a centreline, with a sidewalk on either side."""

    name: str
    start_m: Point
    heading_deg: float
    width_m: float
    sidewalk_m: float
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class Zone:
    """The whole width of a road between two distances from its start.

    A vehicle that starts here stands in its middle, along the road, or against it if `reverse`.
    """

    name: str
    road: str
    from_m: float
    to_m: float
    reverse: bool = False


@dataclass(frozen=True)
class Path:
    """One task: from a start zone to an ending zone, with exits closed."""

    name: str
    start: str
    end: str
    closures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Closure:
    """A building across a road, there in the episodes whose path names it."""

    name: str
    road: str
    at_m: float
    depth_m: float
    height_m: float


@dataclass(frozen=True)
class Walk:
    """Where a group walks back and forth: across a road, along it, or through given points."""

    kind: Literal["across", "along", "points"]
    road: str | None = None
    at_m: float | None = None
    from_m: float | None = None
    to_m: float | None = None
    offset_m: float = 0.0
    points_m: tuple[Point, ...] = ()


@dataclass(frozen=True)
class PedestrianGroup:
    """People on one walk; `standing` of them never move.

    `draw` says whether speed, phase and direction are drawn once for the group or for each person.
    """

    name: str
    count: int
    spread_m: float
    walk: Walk
    standing: int = 0
    draw: Literal["group", "pedestrian"] = "group"
    speed_mps: Range | None = None


@dataclass(frozen=True)
class BuildingRow:
    """House fronts along one side of a road, or one house across its start or end.

    A house of a row stands where no road, no sidewalk and no earlier house is.
    """

    road: str
    side: Literal["left", "right", "start", "end"]
    from_m: float
    to_m: float
    setback_m: float
    front_m: Range
    depth_m: Range
    height_m: Range


@dataclass(frozen=True)
class Obstacle:
    """Something that stands still: what it is, where, which way it faces.

    `size_m` is (length, width, height); length runs along the heading. It is what a vehicle can
    hit: of a tree its trunk, of a light its post, while crown, arm and head hang above.
    """

    kind: Kind
    center_m: Point
    yaw_deg: float
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class ObstacleRow:
    """Obstacles of one kind along a road, `offset_m` to the left of its middle.

    They face as cars that keep right are parked: on the right along the road, on the left against
    it. Whatever would stand on another road than its own, or in a house, is left out.
    """

    kind: Kind
    road: str
    offset_m: float
    from_m: float
    to_m: float
    every_m: float
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Crosswalk:
    """Stripes over the whole width of a road, `depth_m` along it."""

    road: str
    at_m: float
    depth_m: float


@dataclass(frozen=True)
class Scene:
    """A whole environment as data; `load_scene` reads and checks one.

    Grass lies between the roads and `terrain_m` beyond their bounds; 0 for none. `corner_radius_m`
    rounds the kerb where roads meet.
    """

    name: str
    frame_rate_hz: float
    time_limit_steps: int
    categories: tuple[str, ...]
    layout_seed: int
    camera: CameraConfig
    vehicle: VehicleConfig
    roads: tuple[Road, ...]
    zones: tuple[Zone, ...]
    paths: tuple[Path, ...]
    pedestrian_speed_mps: Mapping[SpeedMode, Range]
    pedestrian_groups: tuple[PedestrianGroup, ...] = ()
    building_rows: tuple[BuildingRow, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    obstacle_rows: tuple[ObstacleRow, ...] = ()
    closures: tuple[Closure, ...] = ()
    crosswalks: tuple[Crosswalk, ...] = ()
    terrain_m: float = 0.0
    corner_radius_m: float = 0.0

    @property
    def time_limit_s(self) -> float:
        """The time limit in seconds, whatever the frame rate."""
        return self.time_limit_steps / self.frame_rate_hz

    @property
    def num_pedestrians(self) -> int:
        """How many people the scene holds."""
        return sum(group.count for group in self.pedestrian_groups)
