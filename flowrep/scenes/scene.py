"""The data of a scene: frozen dataclasses whose field names are the keys of the YAML file.

When a scene is loaded, pydantic checks types and ranges, and adds the key to what a `__post_init__`
refuses. After that these are plain dataclasses of floats and ints.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import AfterValidator, ConfigDict, Field, Strict, StringConstraints

from flowrep.choices import FRAME_RATES_HZ, SpeedMode

Kind = Literal["house", "tree", "fence", "car", "traffic_light", "lamp_post"]
Range = tuple[float, float]

CATEGORIES = (
    "sky", "road", "sidewalk", "building", "pedestrian", "terrain", "crosswalk", "tree", "fence",
    "car", "traffic_light",
)  # fmt: skip
CATEGORY_ID: dict[str, int] = {name: number for number, name in enumerate(CATEGORIES)}
"""The semantic classes and their ids; `flowrep.viz.CLASS_COLOURS` has their colours."""

# The semantic class of each kind: lamp posts share that of buildings.
CATEGORY_OF_KIND: dict[Kind, str] = {kind: kind for kind in get_args(Kind)}
CATEGORY_OF_KIND |= {"house": "building", "lamp_post": "building"}
# Least heights of kinds with wheels or lamps of a fixed size; others may have any height.
LEAST_HEIGHT_M: dict[Kind, float] = {"car": 0.7, "traffic_light": 1.0, "lamp_post": 0.3}


class SceneError(ValueError):
    """An invalid scene; the message names the file, the key, the problem and the remedy."""


def num_classes(categories: Sequence[str]) -> int:
    """Returns how many ids a semantic map of these categories needs (largest id plus one).

    >>> num_classes(("sky", "road", "sidewalk", "building", "pedestrian"))
    5
    """
    return 1 + max(CATEGORY_ID[name] for name in categories)


def _in_order(bounds: Range) -> Range:
    if bounds[0] > bounds[1]:
        raise ValueError("give [lowest, highest]")
    return bounds


def _all_modes(ranges: dict[SpeedMode, Range]) -> dict[SpeedMode, Range]:
    if set(ranges) != set(get_args(SpeedMode)):
        raise ValueError(f"give all of {', '.join(get_args(SpeedMode))}")
    return ranges


def _named_once(parts: Sequence[Any]) -> Sequence[Any]:
    names = [getattr(part, "name", part) for part in parts]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two entries are named {name!r}; rename one of them")
    return parts


def _check_forward(from_m: float, to_m: float) -> None:
    if from_m >= to_m:
        raise ValueError("give from_m below to_m")


def _check_height(kind: Kind, size_m: tuple[float, float, float]) -> None:
    if size_m[2] < (least_m := LEAST_HEIGHT_M.get(kind, 0.0)):
        raise ValueError(f"a {kind} is at least {least_m} m high")


# Strict: a number in quotes, or true for 1, is a mistake.
Number = Annotated[float, Strict()]
Positive = Annotated[float, Strict(), Field(gt=0.0)]
NotNegative = Annotated[float, Strict(), Field(ge=0.0)]
Angle = Annotated[float, Strict(), Field(ge=-360.0, le=360.0)]
HouseSide = Annotated[float, Strict(), Field(ge=1.0)]  # rows are filled house by house
Count = Annotated[int, Strict(), Field(ge=1)]
Pixels = Annotated[int, Strict(), Field(ge=1, le=4096)]  # 4K; more would exhaust memory
Whole = Annotated[int, Strict(), Field(ge=0)]
Name = Annotated[str, StringConstraints(min_length=1)]
FileName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
Point = tuple[Number, Number]
Size3 = tuple[Positive, Positive, Positive]
SpeedRange = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_in_order)]
HouseRange = Annotated[tuple[HouseSide, HouseSide], AfterValidator(_in_order)]


# The docstrings of the classes are the descriptions in the JSON schema that editors show.


class Part:
    """Base of the dataclasses read from a mapping whose keys are exactly their fields."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class CameraConfig(Part):
    """A camera on the vehicle: `fov_deg` is vertical, `pitch_deg` is positive upwards."""

    height_px: Pixels
    width_px: Pixels
    fov_deg: Annotated[float, Strict(), Field(ge=1.0, le=179.0)]
    mount_height_m: Positive
    mount_forward_m: Number
    pitch_deg: Annotated[float, Strict(), Field(ge=-90.0, le=90.0)]
    near_m: Positive
    far_m: Positive

    def __post_init__(self) -> None:
        if self.near_m >= self.far_m:
            raise ValueError("give far_m beyond near_m")

    @property
    def focal_px(self) -> float:
        """The focal length in pixels, the same along both axes."""
        return 0.5 * self.height_px / math.tan(math.radians(self.fov_deg) / 2)


@dataclass(frozen=True)
class VehicleConfig(Part):
    """Footprint, speed and turning of the vehicle."""

    length_m: Positive
    width_m: Positive
    height_m: Positive
    speed_mps: Positive
    yaw_acceleration_dps2: Positive
    max_yaw_rate_dps: Positive


@dataclass(frozen=True)
class Piece(Part):
    """One stretch of centreline: straight, or an arc (positive degrees turn left)."""

    straight_m: Positive | None = None
    arc_radius_m: Positive | None = None
    arc_deg: Angle | None = None

    def __post_init__(self) -> None:
        arc = (self.arc_radius_m, self.arc_deg)
        is_straight = self.straight_m is not None and arc == (None, None)
        if not is_straight and (self.straight_m is not None or None in arc or self.arc_deg == 0):
            raise ValueError("give straight_m alone, or arc_radius_m and an arc_deg other than 0")


@dataclass(frozen=True)
class Road(Part):
    """A drivable ribbon along a centreline, with a sidewalk on either side."""

    name: Name
    start_m: Point
    heading_deg: Angle
    width_m: Positive
    sidewalk_m: NotNegative
    pieces: Annotated[tuple[Piece, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Zone(Part):
    """The whole width of a road between two distances from its start.

    A vehicle starts in the middle of its zone, facing along the road, or against it if `reverse`.
    """

    name: Name
    road: Name
    from_m: Number
    to_m: Number
    reverse: Annotated[bool, Strict()] = False

    def __post_init__(self) -> None:
        _check_forward(self.from_m, self.to_m)


@dataclass(frozen=True)
class Path(Part):
    """The task of an episode: from a start zone to an end zone, with some exits closed."""

    name: Name
    start: Name
    end: Name
    closures: tuple[Name, ...] = ()


@dataclass(frozen=True)
class Closure(Part):
    """A building across a road, present in episodes whose path names it."""

    name: Name
    road: Name
    at_m: Number
    depth_m: Positive
    height_m: Positive


_KEYS_OF_WALK = {
    "across": {"road", "at_m"},
    "along": {"road", "from_m", "to_m", "offset_m"},
    "points": {"points_m"},
}


@dataclass(frozen=True)
class Walk(Part):
    """The walk of a group, back and forth: across a road, along it, or through given points."""

    kind: Literal["across", "along", "points"]
    road: Name | None = None
    at_m: Number | None = None
    from_m: Number | None = None
    to_m: Number | None = None
    offset_m: Number = 0.0
    points_m: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        keys = _KEYS_OF_WALK[self.kind]
        given = {field.name for field in fields(self) if getattr(self, field.name) != field.default}
        if given - {"kind", "offset_m"} != keys - {"offset_m"} or not given <= {"kind", *keys}:
            raise ValueError(f"a walk of kind {self.kind!r} has {', '.join(sorted(keys))}")
        if self.kind == "along" and self.from_m == self.to_m:
            raise ValueError("give from_m and to_m that differ")


@dataclass(frozen=True)
class PedestrianGroup(Part):
    """People on one walk; `standing` of them never move.

    `draw` says whether speed, phase and direction are drawn once for the group or for each person.
    """

    name: Name
    count: Count
    spread_m: NotNegative
    walk: Walk
    standing: Whole = 0
    draw: Literal["group", "pedestrian"] = "group"
    speed_mps: SpeedRange | None = None

    def __post_init__(self) -> None:
        if self.standing > self.count:
            raise ValueError("standing is more than count; give a smaller number")


@dataclass(frozen=True)
class BuildingRow(Part):
    """House fronts along one side of a road, or one house across its start or end.

    Houses of a row are placed only where there is no road, sidewalk or earlier house.
    """

    road: Name
    side: Literal["left", "right", "start", "end"]
    from_m: Number
    to_m: Number
    setback_m: NotNegative
    front_m: HouseRange
    depth_m: HouseRange
    height_m: HouseRange

    def __post_init__(self) -> None:
        if self.side in ("left", "right"):
            _check_forward(self.from_m, self.to_m)
        elif self.from_m or self.to_m:
            raise ValueError(f"give 0 for from_m and to_m: it is one house at the {self.side}")


@dataclass(frozen=True)
class Obstacle(Part):
    """A static object: kind, position, heading and size.

    `size_m` is (length, width, height), with length along the heading. It covers the part that a
    vehicle can hit: the trunk of a tree or the post of a light, not the parts that hang above.
    """

    kind: Kind
    center_m: Point
    yaw_deg: Angle
    size_m: Size3

    def __post_init__(self) -> None:
        _check_height(self.kind, self.size_m)


@dataclass(frozen=True)
class ObstacleRow(Part):
    """Obstacles of one kind along a road, `offset_m` to the left of its centreline.

    They face like parked cars in right-hand traffic: along the road on the right, against it on the
    left. Obstacles that would stand on another road or in a house are left out.
    """

    kind: Kind
    road: Name
    offset_m: Number
    from_m: Number
    to_m: Number
    every_m: Positive
    size_m: Size3

    def __post_init__(self) -> None:
        _check_forward(self.from_m, self.to_m)
        _check_height(self.kind, self.size_m)


@dataclass(frozen=True)
class Crosswalk(Part):
    """Stripes across the whole width of a road, extending `depth_m` along it."""

    road: Name
    at_m: Number
    depth_m: Positive


@dataclass(frozen=True)
class Scene(Part):
    """A complete scene as data; `load_scene` reads and checks one.

    Grass covers the ground between the roads and up to `terrain_m` beyond their bounds; 0 for none.
    `corner_radius_m` rounds the kerb where roads meet. `symmetric` says that the mirror image of a
    drive is a possible drive in this scene, too, so that an agent may learn from mirror images.
    """

    name: FileName
    frame_rate_hz: Annotated[float, Strict(), Field(ge=FRAME_RATES_HZ[0], le=FRAME_RATES_HZ[1])]
    time_limit_steps: Count
    categories: Annotated[tuple[Name, ...], AfterValidator(_named_once)]
    layout_seed: Whole
    camera: CameraConfig
    vehicle: VehicleConfig
    roads: Annotated[tuple[Road, ...], Field(min_length=1), AfterValidator(_named_once)]
    zones: Annotated[tuple[Zone, ...], Field(min_length=1), AfterValidator(_named_once)]
    paths: Annotated[tuple[Path, ...], Field(min_length=1), AfterValidator(_named_once)]
    pedestrian_speed_mps: Annotated[dict[SpeedMode, SpeedRange], AfterValidator(_all_modes)]
    pedestrian_groups: Annotated[tuple[PedestrianGroup, ...], AfterValidator(_named_once)] = ()
    building_rows: tuple[BuildingRow, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    obstacle_rows: tuple[ObstacleRow, ...] = ()
    closures: Annotated[tuple[Closure, ...], AfterValidator(_named_once)] = ()
    crosswalks: tuple[Crosswalk, ...] = ()
    terrain_m: NotNegative = 0.0
    corner_radius_m: NotNegative = 0.0
    symmetric: Annotated[bool, Strict()] = False

    @property
    def time_limit_s(self) -> float:
        """The time limit in seconds, at any frame rate."""
        return self.time_limit_steps / self.frame_rate_hz

    @property
    def num_pedestrians(self) -> int:
        """The number of people in the scene."""
        return sum(group.count for group in self.pedestrian_groups)
