"""The section `format` of `flowrep.factorize`: the options of each reader of recordings."""

from dataclasses import dataclass
from typing import Annotated, get_args

from pydantic import Field, model_validator
from pydantic_core import CoreSchema, core_schema

from flowrep.config.expectations import Expectation, NotNegative, Number, OneOf, Switch, Text, Whole
from flowrep.config.section import ChosenBy, Section
from flowrep.config.violations import broken_rule
from flowrep.geometry import (
    CameraAxes,
    Channels,
    DepthKind,
    Direction,
    Grid,
    PoseDirection,
    PoseLayout,
)

PREFIX = "flowrep.sequences."


@dataclass(frozen=True)
class Vector(Expectation):
    """A list of finite numbers of a given length."""

    what: str
    size: int

    def _schema(self) -> CoreSchema:
        number = core_schema.float_schema(strict=True, allow_inf_nan=False)
        return core_schema.list_schema(
            number, min_length=self.size, max_length=self.size, strict=True
        )

    def _words(self) -> str:
        return f"{self.what}, {self.size} numbers"


PINHOLE = Vector("[fx, fy, cx, cy] in pixels", 4)
AXES = OneOf(get_args(CameraAxes))


class Reader(Section):
    """A reader without options; `_target_` is its class."""

    target: str = Field(alias="_target_", examples=["flowrep.sequences.Frames"])


class Frames(Reader):
    """The plain layout."""

    pose_layout: Annotated[str, OneOf(get_args(PoseLayout))]
    pose_direction: Annotated[str, OneOf(get_args(PoseDirection))]
    pose_axes: Annotated[str, AXES]
    depth_unit_m: Annotated[float | None, Number(above=0, also=(None,))]
    depth_kind: Annotated[str, OneOf(get_args(DepthKind))]
    near_m: Annotated[float | None, Number(above=0, also=(None,))]
    far_m: Annotated[float | None, Number(above=0, also=(None,))]
    flow_direction: Annotated[str, OneOf(get_args(Direction))]
    flow_grid: Annotated[str, OneOf(get_args(Grid))]
    flow_channels: Annotated[str, OneOf(get_args(Channels))]

    @model_validator(mode="after")
    def _planes_are_a_z_buffers(self) -> "Frames":
        for name in ("near_m", "far_m"):
            if (getattr(self, name) is None) == (self.depth_kind == "z_buffer"):
                needed = "a number" if self.depth_kind == "z_buffer" else "null"
                raise broken_rule(name, f"should be {needed} with depth_kind={self.depth_kind}")
        return self


class Kitti(Reader):
    """KITTI scene flow 2015."""

    raw_data: Annotated[str, Text("a folder")] = Field(examples=["raw"])
    mapping: Annotated[str, Text("a file")] = Field(examples=["devkit/mapping/train_mapping.txt"])


class SevenScenes(Reader):
    """7-Scenes."""

    depth_intrinsics: Annotated[list[float], PINHOLE]
    colour_intrinsics: Annotated[list[float], PINHOLE]
    colour_from_depth_m: Annotated[list[float], Vector("[x, y, z] in metres", 3)]


class Sintel(Reader):
    """MPI Sintel."""

    scene: Annotated[str, Text("the name of a scene")] = Field(examples=["alley_1"])
    render: Annotated[str, OneOf(("final", "clean"))]
    backwards: Switch


class StillVideo(Reader):
    """A video."""

    still: Switch


class TartanAir(Reader):
    """TartanAir."""

    backwards: Switch


class Tum(Reader):
    """TUM RGB-D."""

    intrinsics: Annotated[list[float], PINHOLE]
    tolerance_s: NotNegative
    interpolate: Switch


class VKitti2(Reader):
    """Virtual KITTI 2."""

    camera: Annotated[int, Whole(0, 1)]


class Zed(Reader):
    """A folder exported from an SVO."""

    pose_axes: Annotated[str, AXES]


READERS: dict[str, type[Reader]] = {
    f"{PREFIX}{section.__name__}": section
    for section in (
        Frames, Kitti, SevenScenes, Sintel, StillVideo, TartanAir, Tum, VKitti2, Zed
    )
}  # fmt: skip
"""The section of each reader, by its class."""

BY_READER = ChosenBy("_target_", READERS, otherwise=Reader)
