"""The data of a scene: frozen dataclasses whose field names are the keys of the YAML file."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator

from flowrep.scenes.camera import CameraConfig
from flowrep.scenes.fields import (
    MOST_PARTS,
    Angle,
    FileName,
    Flag,
    FrameRate,
    Gap,
    HouseRange,
    Length,
    Name,
    Part,
    People,
    Place,
    Point,
    Seed,
    Size,
    SpeedRange,
    Standing,
    Steps,
    Stride,
    Width,
    up_to,
)
from flowrep.scenes.vehicle import VehicleConfig

SpeedMode = Literal["low", "normal", "high"]
Kind = Literal["house", "tree", "fence", "car", "traffic_light", "lamp_post"]
Range = tuple[float, float]


def _all_modes(ranges: dict[SpeedMode, SpeedRange]) -> dict[SpeedMode, SpeedRange]:
    if set(ranges) != set(get_args(SpeedMode)):
        raise ValueError(f"give all of {', '.join(get_args(SpeedMode))}")
    return ranges


SpeedRanges = Annotated[dict[SpeedMode, SpeedRange], AfterValidator(_all_modes)]

CATEGORY_OF_KIND: dict[Kind, str] = {
    "house": "building",
    "tree": "tree",
    "fence": "fence",
    "car": "car",
    "traffic_light": "traffic_light",
    "lamp_post": "building",
}
"""Semantic class of each kind of box; lamp posts share the class of buildings."""

LEAST_HEIGHT_M: dict[Kind, float] = {"car": 0.7, "traffic_light": 1.0, "lamp_post": 0.3}
"""Least height of kinds with wheels or lamps of a fixed size; others may have any."""


@dataclass(frozen=True)
class Piece(Part):
    """One stretch of centreline: straight, or an arc (positive degrees turn left)."""

    straight_m: Length | None = None
    arc_radius_m: Length | None = None
    arc_deg: Angle | None = None


@dataclass(frozen=True)
class Road(Part):
    """A drivable ribbon along a centreline, with a sidewalk on either side."""

    name: Name
    start_m: Point
    heading_deg: Angle
    width_m: Width
    sidewalk_m: Gap
    pieces: Annotated[tuple[Piece, ...], up_to(MOST_PARTS, least=1)]


@dataclass(frozen=True)
class Zone(Part):
    """The whole width of a road between two distances from its start.

    A vehicle starts in the middle of its zone, facing along the road, or against it if `reverse`.
    """

    name: Name
    road: Name
    from_m: Place
    to_m: Place
    reverse: Flag = False


@dataclass(frozen=True)
class Path(Part):
    """One task: from a start zone to an ending zone, with exits closed."""

    name: Name
    start: Name
    end: Name
    closures: Annotated[tuple[Name, ...], up_to(MOST_PARTS)] = ()


@dataclass(frozen=True)
class Closure(Part):
    """A building across a road, present in episodes whose path names it."""

    name: Name
    road: Name
    at_m: Place
    depth_m: Size
    height_m: Size


@dataclass(frozen=True)
class Walk(Part):
    """The walk of a group, back and forth: across a road, along it, or through given points."""

    kind: Literal["across", "along", "points"]
    road: Name | None = None
    at_m: Place | None = None
    from_m: Place | None = None
    to_m: Place | None = None
    offset_m: Place = 0.0
    points_m: Annotated[tuple[Point, ...], up_to(MOST_PARTS)] = ()


@dataclass(frozen=True)
class PedestrianGroup(Part):
    """People on one walk; `standing` of them never move.

    `draw` determines whether speed, phase and direction are drawn once for the group or for each
    person.
    """

    name: Name
    count: People
    spread_m: Gap
    walk: Walk
    standing: Standing = 0
    draw: Literal["group", "pedestrian"] = "group"
    speed_mps: SpeedRange | None = None


@dataclass(frozen=True)
class BuildingRow(Part):
    """House fronts along one side of a road, or one house across its start or end.

    Houses of a row are placed only where there is no road, sidewalk or earlier house.
    """

    road: Name
    side: Literal["left", "right", "start", "end"]
    from_m: Place
    to_m: Place
    setback_m: Gap
    front_m: HouseRange
    depth_m: HouseRange
    height_m: HouseRange


@dataclass(frozen=True)
class Obstacle(Part):
    """A static object: kind, position, heading and size.

    `size_m` is (length, width, height), with length along the heading. It covers the part that a
    vehicle can hit: the trunk of a tree or the post of a light, not the parts that hang above.
    """

    kind: Kind
    center_m: Point
    yaw_deg: Angle
    size_m: tuple[Size, Size, Size]


@dataclass(frozen=True)
class ObstacleRow(Part):
    """Obstacles of one kind along a road, `offset_m` to the left of its middle.

    They face like parked cars in right-hand traffic: along the road on the right, against it on the
    left. Obstacles that would stand on another road or in a house are left out.
    """

    kind: Kind
    road: Name
    offset_m: Place
    from_m: Place
    to_m: Place
    every_m: Stride
    size_m: tuple[Size, Size, Size]


@dataclass(frozen=True)
class Crosswalk(Part):
    """Stripes across the whole width of a road, extending `depth_m` along it."""

    road: Name
    at_m: Place
    depth_m: Size


@dataclass(frozen=True)
class Scene(Part):
    """A complete scene as data; `load_scene` reads and checks one.

    Grass covers the ground between the roads and up to `terrain_m` beyond their bounds; 0 for none.
    `corner_radius_m` rounds the kerb where roads meet.
    """

    name: FileName
    frame_rate_hz: FrameRate
    time_limit_steps: Steps
    categories: Annotated[tuple[Name, ...], up_to(MOST_PARTS)]
    layout_seed: Seed
    camera: CameraConfig
    vehicle: VehicleConfig
    roads: Annotated[tuple[Road, ...], up_to(MOST_PARTS, least=1)]
    zones: Annotated[tuple[Zone, ...], up_to(MOST_PARTS, least=1)]
    paths: Annotated[tuple[Path, ...], up_to(MOST_PARTS // 2, least=1)]
    pedestrian_speed_mps: SpeedRanges
    pedestrian_groups: Annotated[tuple[PedestrianGroup, ...], up_to(MOST_PARTS)] = ()
    building_rows: Annotated[tuple[BuildingRow, ...], up_to(MOST_PARTS)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], up_to(5 * MOST_PARTS)] = ()
    obstacle_rows: Annotated[tuple[ObstacleRow, ...], up_to(MOST_PARTS)] = ()
    closures: Annotated[tuple[Closure, ...], up_to(MOST_PARTS)] = ()
    crosswalks: Annotated[tuple[Crosswalk, ...], up_to(MOST_PARTS)] = ()
    terrain_m: Gap = 0.0
    corner_radius_m: Gap = 0.0

    @property
    def time_limit_s(self) -> float:
        """The time limit in seconds, at any frame rate."""
        return self.time_limit_steps / self.frame_rate_hz

    @property
    def num_pedestrians(self) -> int:
        """The number of people in the scene."""
        return sum(group.count for group in self.pedestrian_groups)
