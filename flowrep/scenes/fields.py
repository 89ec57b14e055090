"""Quantities that a scene file may hold: finite, and within what can be laid out and simulated.

Pydantic reads the ranges when a file is checked; to everyone else these are floats and ints.
"""

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, Strict, StringConstraints

MOST_METRES = 5_000.0
"""No road is longer and no place further from the origin."""

MOST_PARTS = 100
"""How many roads, rows, closures and so on a scene may list; half as many paths, and five times as
many single obstacles."""


class Part:
    """What is read from a mapping whose keys are exactly its fields."""

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
WalkingSpeed = Annotated[float, Strict(), Field(ge=0.0, le=20.0)]

FrameRate = Annotated[float, Strict(), Field(ge=0.5, le=1_000.0)]
Steps = Annotated[int, Strict(), Field(ge=1, le=1_000_000)]
Seed = Annotated[int, Strict(), Field(ge=0, le=2**32 - 1)]
Pixels = Annotated[int, Strict(), Field(ge=1, le=4096)]
FieldOfView = Annotated[float, Strict(), Field(ge=1.0, le=179.0)]
Pitch = Annotated[float, Strict(), Field(ge=-90.0, le=90.0)]
VehicleSize = Annotated[float, Strict(), Field(ge=0.1, le=20.0)]
VehicleSpeed = Annotated[float, Strict(), Field(ge=0.1, le=100.0)]
TurnRate = Annotated[float, Strict(), Field(ge=0.1, le=10_000.0)]

People = Annotated[int, Strict(), Field(ge=1, le=85)]
Standing = Annotated[int, Strict(), Field(ge=0, le=85)]
Flag = Annotated[bool, Strict()]

Point = tuple[Place, Place]
SpeedRange = Annotated[tuple[WalkingSpeed, WalkingSpeed], AfterValidator(_in_order)]
HouseRange = Annotated[tuple[HouseSide, HouseSide], AfterValidator(_in_order)]


def up_to(most: int, least: int = 0) -> Any:
    """Returns the bounds of a list's length."""
    return Field(min_length=least, max_length=most)
