"""Types of the values in a scene file, limited to what can be laid out and simulated.

Pydantic checks the ranges when a file is loaded; other code sees plain floats and ints.
"""

from typing import Annotated, Any, ClassVar

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
