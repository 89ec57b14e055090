"""The data of a scene: frozen dataclasses whose field names are the keys of the YAML file.

When a scene is loaded, pydantic checks types and ranges, and adds the key to what a `__post_init__`
refuses. After that these are plain dataclasses of floats and ints.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, Strict, StringConstraints

from flowrep.config.options import FRAME_RATES_HZ, SpeedMode

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


def _as_range(sizes: Any) -> Any:
    return sizes if isinstance(sizes, Sequence) and not isinstance(sizes, str) else (sizes, sizes)


def _one_if_equal(sizes: Range) -> float | Range:
    return sizes[0] if sizes[0] == sizes[1] else sizes


def _all_modes(ranges: dict[SpeedMode, Range]) -> dict[SpeedMode, Range]:
    if set(ranges) != set(get_args(SpeedMode)):
        raise ValueError(f"give all of {', '.join(get_args(SpeedMode))}")
    return ranges


def _all_or_named(names: Any) -> Any:
    return CATEGORIES if names == "all" else names


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


# Strict: a number in quotes, or true for 1, is a mistake. Beyond 10 km, coordinates in float32 are
# further apart than a millimetre; whatever is counted along a road is bounded by this, too.
MOST_M = 10_000.0
Position = Annotated[float, Strict(), Field(ge=-MOST_M, le=MOST_M)]
Length = Annotated[float, Strict(), Field(gt=0.0, le=MOST_M)]
LengthOrZero = Annotated[float, Strict(), Field(ge=0.0, le=MOST_M)]
Positive = Annotated[float, Strict(), Field(gt=0.0)]
NotNegative = Annotated[float, Strict(), Field(ge=0.0)]
Angle = Annotated[float, Strict(), Field(ge=-360.0, le=360.0)]
HouseSide = Annotated[float, Strict(), Field(ge=1.0, le=MOST_M)]  # rows are filled house by house
Count = Annotated[int, Strict(), Field(ge=1, le=1_000_000_000)]
MOST_PX = 4096  # 4K; more would exhaust memory
Pixels = Annotated[int, Strict(), Field(ge=1, le=MOST_PX)]
Whole = Annotated[int, Strict(), Field(ge=0)]
Name = Annotated[str, StringConstraints(min_length=1)]
FileName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
Point = tuple[Position, Position]
_Part = TypeVar("_Part")
_GOLDEN = (math.sqrt(5) - 1) / 2
MOST_PARTS = 1_000  # of a kind: as many take a second to check
Parts = Annotated[tuple[_Part, ...], Field(max_length=MOST_PARTS)]
Size3 = tuple[Length, Length, Length]
SpeedRange = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_in_order)]
PersonSize = Annotated[float, Strict(), Field(ge=0.1, le=3.0)]
SizeRange = tuple[PersonSize, PersonSize]
SizeOrRange = Annotated[
    SizeRange,
    AfterValidator(_in_order),
    AfterValidator(_one_if_equal),
    BeforeValidator(_as_range, json_schema_input_type=PersonSize | SizeRange),
]
HouseRange = Annotated[tuple[HouseSide, HouseSide], AfterValidator(_in_order)]


# `docs/scene_keys.py` makes the descriptions that editors show of the docstrings of classes and
# fields.


class Part:
    """Base of the dataclasses read from a mapping whose keys are exactly their fields."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class CameraConfig(Part):
    """A camera on the vehicle."""

    height_px: Pixels
    """Height of all maps."""
    width_px: Pixels
    """Width of all maps."""
    fov_deg: Annotated[float, Strict(), Field(ge=1.0, le=179.0)]
    """Vertical field of view."""
    mount_height_m: Length
    """Height above the ground."""
    mount_forward_m: Position
    """Distance ahead of the vehicle's centre, negative behind it."""
    pitch_deg: Annotated[float, Strict(), Field(ge=-90.0, le=90.0)]
    """Angle above the horizon, negative to look down."""
    near_m: Length
    """Nearest depth that is drawn."""
    far_m: Length
    """Farthest depth that is drawn; everything beyond is sky."""

    def __post_init__(self) -> None:
        if self.near_m >= self.far_m:
            raise ValueError("give far_m beyond near_m")

    @property
    def focal_px(self) -> float:
        """The focal length in pixels, the same along both axes."""
        return 0.5 * self.height_px / math.tan(math.radians(self.fov_deg) / 2)

    @property
    def K(self) -> NDArray[np.float64]:
        """The intrinsics [3, 3] of depth, class, instance and flow maps."""
        # Half a pixel right of the middle and above it, as of PyBullet's software renderer, whose
        # pictures the rasteriser's equal; `tests/envs/test_camera.py` measures this.
        cx_px, cy_px = self.width_px / 2 + 0.5, self.height_px / 2 - 0.5
        return np.array([[self.focal_px, 0.0, cx_px], [0.0, self.focal_px, cy_px], [0.0, 0.0, 1.0]])

    @property
    def vehicle_from_cam(self) -> NDArray[np.float64]:
        """The camera's pose on the vehicle [4, 4] (vehicle axes: x forward, z up)."""
        pitch = math.radians(self.pitch_deg)
        sine, cosine = math.sin(pitch), math.cos(pitch)
        return np.array(
            [
                [0.0, sine, cosine, self.mount_forward_m],
                [-1.0, 0.0, 0.0, 0.0],
                [0.0, -cosine, sine, self.mount_height_m],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )


def check_speed(key: str, speed_mps: float, camera: CameraConfig, frame_rate_hz: float) -> None:
    """Raises SceneError if a step leads farther than the camera sees."""
    # Two frames would have nothing in common, and the footprint is tested all along a step.
    if speed_mps > (most_mps := camera.far_m * frame_rate_hz):
        raise SceneError(
            f"{key}: is {speed_mps:g} m/s, {speed_mps / frame_rate_hz:g} m in a step, but the "
            f"camera sees {camera.far_m:g} m; give {most_mps:g} m/s or less"
        )


@dataclass(frozen=True)
class VehicleConfig(Part):
    """Size, speed and turning of the vehicle."""

    length_m: Length
    """Length of the footprint, which must stay on the road."""
    width_m: Length
    """Width of the footprint."""
    height_m: Length
    """Height of the box that collides."""
    speed_mps: Positive
    """Constant speed in m/s."""
    yaw_acceleration_dps2: Positive
    """α: an action to turn changes the yaw rate by α times the duration of a step, in °/s²."""
    max_yaw_rate_dps: Positive
    """Largest yaw rate to either side, in °/s."""


@dataclass(frozen=True)
class Piece(Part):
    """One stretch of the centreline after the other, straight or an arc."""

    straight_m: Length | None = None
    """Length of a straight piece, which has no other key."""
    arc_radius_m: Length | None = None
    """Radius of an arc."""
    arc_deg: Angle | None = None
    """Angle of an arc, positive to the left."""

    def __post_init__(self) -> None:
        arc = (self.arc_radius_m, self.arc_deg)
        is_straight = self.straight_m is not None and arc == (None, None)
        if not is_straight and (self.straight_m is not None or None in arc or self.arc_deg == 0):
            raise ValueError("give straight_m alone, or arc_radius_m and an arc_deg other than 0")


@dataclass(frozen=True)
class Road(Part):
    """A drivable ribbon along a centreline, with sidewalks; roads that overlap merge."""

    name: Name
    """The name by which other keys refer to the road."""
    start_m: Point
    """Where the centreline begins, [x, y]."""
    heading_deg: Angle
    """The centreline's direction there."""
    width_m: Length
    """Width of the drivable ground."""
    sidewalk_m: LengthOrZero
    """Width of each sidewalk; 0 for none."""
    pieces: Annotated[Parts[Piece], Field(min_length=1)]


@dataclass(frozen=True)
class Zone(Part):
    """The whole width of a road between two distances along it, where episodes start or end."""

    name: Name
    """The name by which paths refer to the zone."""
    road: Name
    """A road's name."""
    from_m: Position
    """Where the zone begins; an episode starts in its middle."""
    to_m: Position
    """Where the zone ends; one in which episodes end is at least 1 m long."""
    reverse: Annotated[bool, Strict()] = False
    """Whether a vehicle that starts here faces against the road's direction."""

    def __post_init__(self) -> None:
        _check_forward(self.from_m, self.to_m)


@dataclass(frozen=True)
class Path(Part):
    """The task of an episode, which draws one of all."""

    name: Name
    """The path's name, in tables and in the env's `info`."""
    start: Name
    """The zone in which it starts."""
    end: Name
    """The zone that has to be reached."""
    closures: Parts[Name] = ()
    """The closures that are present in its episodes."""


@dataclass(frozen=True)
class Closure(Part):
    """A building across a road and its sidewalks, present in episodes whose path names it."""

    name: Name
    """The name by which paths refer to it."""
    road: Name
    """A road's name."""
    at_m: Position
    """Where its middle is."""
    depth_m: Length
    """Its length along the road."""
    height_m: Length
    """Its height."""


_KEYS_OF_WALK = {
    "across": {"road", "at_m"},
    "along": {"road", "from_m", "to_m", "offset_m"},
    "points": {"points_m"},
}


@dataclass(frozen=True)
class Walk(Part):
    """The line on which a group walks back and forth."""

    kind: Literal["across", "along", "points"]
    """Across a road (at `at_m`), along it (`from_m`, `to_m`, `offset_m`), or through `points_m`."""
    road: Name | None = None
    """A road's name."""
    at_m: Position | None = None
    """Where people cross the road and its sidewalks."""
    from_m: Position | None = None
    """One end of a walk along the road."""
    to_m: Position | None = None
    """The other end."""
    offset_m: Position = 0.0
    """Distance of a walk along a road to the left of its centreline."""
    points_m: Parts[Point] = ()
    """The points [x, y] that a walk connects."""

    def __post_init__(self) -> None:
        keys = _KEYS_OF_WALK[self.kind]
        given = {field.name for field in fields(self) if getattr(self, field.name) != field.default}
        if given - {"kind", "offset_m"} != keys - {"offset_m"} or not given <= {"kind", *keys}:
            raise ValueError(f"a walk of kind {self.kind!r} has {', '.join(sorted(keys))}")
        if self.kind == "along" and self.from_m == self.to_m:
            raise ValueError("give from_m and to_m that differ")


@dataclass(frozen=True)
class PedestrianGroup(Part):
    """People who walk back and forth from a random phase, each in a separate lane."""

    name: Name
    """The group's name, for error messages."""
    count: Count
    """The number of people."""
    spread_m: LengthOrZero
    """Width of all lanes together, and the group's length along the walk."""
    walk: Walk
    standing: Whole = 0
    """How many of them stand still."""
    draw: Literal["group", "pedestrian"] = "group"
    """Whether speed and phase are drawn once for the group, or for each person."""
    speed_mps: SpeedRange | None = None
    """[lowest, highest] speed, instead of that of the speed mode."""

    def __post_init__(self) -> None:
        if self.standing > self.count:
            raise ValueError("standing is more than count; give a smaller number")


@dataclass(frozen=True)
class BuildingRow(Part):
    """Houses along one side of a road, wherever there is room, or one across its start or end."""

    road: Name
    """A road's name."""
    side: Literal["left", "right", "start", "end"]
    """The side of the road, seen along it; `start` and `end` give one house."""
    from_m: Position
    """Where a row begins; 0 for `start` and `end`."""
    to_m: Position
    """Where a row ends; 0 for `start` and `end`."""
    setback_m: LengthOrZero
    """Distance of the fronts from the road's edge, at least the sidewalk's width; up to 0.8 m more
    is drawn for each house. For `start` and `end`, the distance from the end of the road."""
    front_m: HouseRange
    """[least, greatest] width of a house along the road."""
    depth_m: HouseRange
    """[least, greatest] depth of a house."""
    height_m: HouseRange
    """[least, greatest] height of a house."""

    def __post_init__(self) -> None:
        if self.side in ("left", "right"):
            _check_forward(self.from_m, self.to_m)
        elif self.from_m or self.to_m:
            raise ValueError(f"give 0 for from_m and to_m: it is one house at the {self.side}")


@dataclass(frozen=True)
class Obstacle(Part):
    """A static object beside the road, or on it."""

    kind: Kind
    """What it is; a `lamp_post` has the category building, as a `house`."""
    center_m: Point
    """Where it stands, [x, y]."""
    yaw_deg: Angle
    """Its heading."""
    size_m: Size3
    """[length, width, height] of what can be hit: the trunk of a tree, not its crown. Cars are at
    least 0.7 m high, traffic lights 1 m, lamp posts 0.3 m."""

    def __post_init__(self) -> None:
        _check_height(self.kind, self.size_m)


@dataclass(frozen=True)
class ObstacleRow(Part):
    """Obstacles of one kind along a road, except on another road or in a house.

    They face like parked cars in right-hand traffic: along the road on the right, against it on the
    left.
    """

    kind: Kind
    """As of an obstacle."""
    road: Name
    """A road's name."""
    offset_m: Position
    """Distance to the left of the road's centreline."""
    from_m: Position
    """Where the first one stands."""
    to_m: Position
    """Where the row ends."""
    every_m: Length
    """Distance from one to the next."""
    size_m: Size3
    """As of an obstacle."""

    def __post_init__(self) -> None:
        _check_forward(self.from_m, self.to_m)
        _check_height(self.kind, self.size_m)


@dataclass(frozen=True)
class Crosswalk(Part):
    """Stripes across the whole width of a road."""

    road: Name
    """A road's name."""
    at_m: Position
    """Where their middle is."""
    depth_m: Length
    """Their length along the road."""


@dataclass(frozen=True)
class Scene(Part):
    """A complete scene as data; `load_scene` reads and checks one."""

    name: FileName
    """The scene's name, which is also that of its file."""
    frame_rate_hz: Annotated[float, Strict(), Field(ge=FRAME_RATES_HZ[0], le=FRAME_RATES_HZ[1])]
    """Steps per second."""
    time_limit_steps: Count
    """The longest episode in steps; at another frame rate, the limit in seconds stays the same."""
    categories: Annotated[
        Parts[Name],
        AfterValidator(_named_once),
        BeforeValidator(_all_or_named, json_schema_input_type=Parts[Name] | Literal["all"]),
    ]
    """The classes that the semantic map may show, whose ids are in `flowrep.scenes.CATEGORY_ID`; an
    agent that reads them can drive wherever there are no others. `all` stands for those of all
    scenes."""
    layout_seed: Whole
    """Seed of the houses' sizes and fronts, which are drawn once for the scene."""
    camera: CameraConfig
    vehicle: VehicleConfig
    roads: Annotated[Parts[Road], Field(min_length=1), AfterValidator(_named_once)]
    zones: Annotated[Parts[Zone], Field(min_length=1), AfterValidator(_named_once)]
    paths: Annotated[Parts[Path], Field(min_length=1), AfterValidator(_named_once)]
    pedestrian_speed_mps: Annotated[dict[SpeedMode, SpeedRange], AfterValidator(_all_modes)]
    """[lowest, highest] speed of people in each of the modes low, normal and high."""
    pedestrian_size: SizeOrRange = 1.0  # type: ignore[assignment]  # a single size is kept
    """Size of people: at 1 they are 1.75 m tall, and 0.6 m wide with swinging arms. With [smallest,
    largest], each person has a size in between, the same in all episodes."""
    pedestrian_groups: Annotated[Parts[PedestrianGroup], AfterValidator(_named_once)] = ()
    building_rows: Parts[BuildingRow] = ()
    obstacles: tuple[Obstacle, ...] = ()
    obstacle_rows: Parts[ObstacleRow] = ()
    closures: Annotated[Parts[Closure], AfterValidator(_named_once)] = ()
    crosswalks: Parts[Crosswalk] = ()
    terrain_m: LengthOrZero = 0.0
    """How far grass extends beyond the roads' bounding box, which it fills; 0 for none."""
    corner_radius_m: LengthOrZero = 0.0
    """Radius of the kerb where roads meet; a gap narrower than twice this becomes road."""
    symmetric: Annotated[bool, Strict()] = False
    """Whether the mirror image of all roads and paths is the same street, so that agents may learn
    from mirror images."""

    @property
    def time_limit_s(self) -> float:
        """The time limit in seconds, at any frame rate."""
        return self.time_limit_steps / self.frame_rate_hz

    @property
    def num_pedestrians(self) -> int:
        """The number of people in the scene."""
        return sum(group.count for group in self.pedestrian_groups)

    @property
    def pedestrian_sizes(self) -> NDArray[Any]:
        """The size of each person, `[P]`."""
        low, high = np.broadcast_to(self.pedestrian_size, 2)
        # The golden ratio's multiples spread any few successive people over the whole range.
        return low + (high - low) * (_GOLDEN * np.arange(1, self.num_pedestrians + 1) % 1)

    @property
    def largest_size(self) -> float:
        """The largest size of people, which keeps their walks apart."""
        return float(np.max(self.pedestrian_size))
