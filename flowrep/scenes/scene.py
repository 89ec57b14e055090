"""The data of a scene: frozen dataclasses whose field names are the keys of the YAML file.

Pydantic checks types and ranges when a file is loaded; other code sees plain floats and ints.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field, Strict, StringConstraints

MOST_METRES = 5_000.0
"""Greatest length of a road, and greatest coordinate of a place."""

MOST_PARTS = 100
"""Most roads, rows, closures and so on in a scene; paths are limited to half as many, single
obstacles to five times as many."""

MOST_WALKING_MPS = 20.0
MOST_DRIVING_MPS = 100.0
"""Greatest speeds of people and of the vehicle."""

FRAME_RATES_HZ = (0.5, 1_000.0)
"""Lowest and highest frame rate of an environment."""


class Part:
    """Base of the dataclasses read from a mapping whose keys are exactly their fields."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


def _in_order(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError("give [lowest, highest]")
    return bounds


Name = Annotated[str, StringConstraints(pattern=r"^\S(.*\S)?$", max_length=64)]
FileName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=64)]

Place = Annotated[float, Strict(), Field(ge=-MOST_METRES, le=MOST_METRES)]
Length = Annotated[float, Strict(), Field(ge=0.01, le=MOST_METRES)]
Gap = Annotated[float, Strict(), Field(ge=0.0, le=1_000.0)]
Width = Annotated[float, Strict(), Field(ge=0.5, le=100.0)]
Size = Annotated[float, Strict(), Field(ge=0.01, le=200.0)]
HouseSide = Annotated[float, Strict(), Field(ge=1.0, le=200.0)]
Stride = Annotated[float, Strict(), Field(ge=0.1, le=MOST_METRES)]
Angle = Annotated[float, Strict(), Field(ge=-360.0, le=360.0)]
WalkingSpeed = Annotated[float, Strict(), Field(ge=0.0, le=MOST_WALKING_MPS)]

FrameRate = Annotated[float, Strict(), Field(ge=FRAME_RATES_HZ[0], le=FRAME_RATES_HZ[1])]
Steps = Annotated[int, Strict(), Field(ge=1, le=1_000_000)]
Seed = Annotated[int, Strict(), Field(ge=0, le=2**32 - 1)]
Pixels = Annotated[int, Strict(), Field(ge=1, le=4096)]
FieldOfView = Annotated[float, Strict(), Field(ge=1.0, le=179.0)]
Pitch = Annotated[float, Strict(), Field(ge=-90.0, le=90.0)]
VehicleSize = Annotated[float, Strict(), Field(ge=0.1, le=20.0)]
VehicleSpeed = Annotated[float, Strict(), Field(ge=0.1, le=MOST_DRIVING_MPS)]
TurnRate = Annotated[float, Strict(), Field(ge=0.1, le=10_000.0)]

People = Annotated[int, Strict(), Field(ge=1, le=85)]
Standing = Annotated[int, Strict(), Field(ge=0, le=85)]
Flag = Annotated[bool, Strict()]

Point = tuple[Place, Place]
SpeedRange = Annotated[tuple[WalkingSpeed, WalkingSpeed], AfterValidator(_in_order)]
HouseRange = Annotated[tuple[HouseSide, HouseSide], AfterValidator(_in_order)]


def up_to(most: int, least: int = 0) -> Any:
    """Returns a field constraint on the length of a list."""
    return Field(min_length=least, max_length=most)


@dataclass(frozen=True)
class CameraConfig(Part):
    """A camera on the vehicle: `fov_deg` is vertical, `pitch_deg` is positive upwards."""

    height_px: Pixels
    width_px: Pixels
    fov_deg: FieldOfView
    mount_height_m: Size
    mount_forward_m: Place
    pitch_deg: Pitch
    near_m: Length
    far_m: Length

    @property
    def focal_px(self) -> float:
        """The focal length in pixels, the same along both axes."""
        return 0.5 * self.height_px / math.tan(math.radians(self.fov_deg) / 2)


NO_OP, TURN_LEFT, TURN_RIGHT = 0, 1, 2
YAW_SIGN = (0.0, 1.0, -1.0)  # by action; left is counter-clockwise


@dataclass(frozen=True)
class VehicleConfig(Part):
    """Footprint, speed and turning of the vehicle."""

    length_m: VehicleSize
    width_m: VehicleSize
    height_m: VehicleSize
    speed_mps: VehicleSpeed
    yaw_acceleration_dps2: TurnRate
    max_yaw_rate_dps: TurnRate


class VehicleState(NamedTuple):
    """Pose of the footprint's centre and yaw rate: scalars, or arrays of the same shape."""

    x_m: Any
    y_m: Any
    yaw_rad: Any
    yaw_rate_rps: Any


def turn(state: VehicleState, sign: Any, dt_s: float, vehicle: VehicleConfig) -> VehicleState:
    """Returns the state with its yaw rate changed by `sign`·α·Δt, within its limit.

    `sign` is the `YAW_SIGN` of the action: a scalar or array like the state's fields.
    """
    limit = math.radians(vehicle.max_yaw_rate_dps)
    rate = state.yaw_rate_rps + sign * (math.radians(vehicle.yaw_acceleration_dps2) * dt_s)
    if isinstance(rate, np.ndarray):
        rate = np.clip(rate, -limit, limit)
    else:
        rate = min(max(rate, -limit), limit)
    return state._replace(yaw_rate_rps=rate)


def roll(state: VehicleState, dt_s: float, speed_mps: float) -> VehicleState:
    """Returns the exact state after driving for `dt_s` along the arc of its yaw rate."""
    xp: Any = np if isinstance(state.yaw_rate_rps, np.ndarray) else math
    angle = state.yaw_rate_rps * dt_s
    # The chord of an arc of length d and angle a is d·sin(a/2)/(a/2), along the mean heading. A
    # tiny angle replaces 0, so that the quotient is 1.
    half = 0.5 * angle
    half_or_tiny = half + (half == 0.0) * 1e-20
    chord = speed_mps * dt_s * (xp.sin(half_or_tiny) / half_or_tiny)
    heading = state.yaw_rad + half
    return VehicleState(
        state.x_m + chord * xp.cos(heading),
        state.y_m + chord * xp.sin(heading),
        state.yaw_rad + angle,
        state.yaw_rate_rps,
    )


def footprint_corners(
    state: VehicleState, vehicle: VehicleConfig, margin_m: float = 0.0
) -> NDArray[np.float64]:
    """Returns the footprint's corners [..., 4, 2], counter-clockwise, widened by `margin_m`."""
    half_length = vehicle.length_m / 2 + margin_m
    half_width = vehicle.width_m / 2 + margin_m
    forward = half_length * np.array([1.0, -1.0, -1.0, 1.0])
    left = half_width * np.array([1.0, 1.0, -1.0, -1.0])
    sine, cosine = np.sin(state.yaw_rad)[..., None], np.cos(state.yaw_rad)[..., None]
    x = np.asarray(state.x_m)[..., None] + cosine * forward - sine * left
    y = np.asarray(state.y_m)[..., None] + sine * forward + cosine * left
    return np.stack([x, y], axis=-1)


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


class SceneError(ValueError):
    """An invalid scene; the message names the file, the key, the problem and the remedy."""

    def __init__(self, source: str, key: str, problem: str, remedy: str) -> None:
        """Composes the message from the location (`source`, `key`), the problem and the remedy."""
        super().__init__(f"{source}: {key or 'the scene'}: {problem}; {remedy}")
