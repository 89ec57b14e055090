"""The config of `flowrep.factorize`, conf/factorize.yaml."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from flowrep.config.expectations import Count, CountOrZero, ListOf, OneOf, Positive, Switch, Whole
from flowrep.config.recordings import BY_READER
from flowrep.config.representations import BY_SOURCE
from flowrep.config.section import Section
from flowrep.config.violations import broken_rule
from flowrep.sequences.output import FLOW_FORMATS


class FlowScale(Section):
    """Flow of full colour, pixels."""

    raw: Positive
    ego: Positive
    obj: Positive


class FactorizeConfig(Section):
    """The whole config of a factorisation."""

    input: str | int = Field(examples=["<folder>"])
    output: str = Field(examples=["<folder>"])
    format: Annotated[Any, BY_READER] = Field(examples=["tum"])
    flow: Annotated[Any, BY_SOURCE] = Field(examples=["estimated"])
    poses: Annotated[str | None, OneOf(("recorded", "estimated"), also=(None,))]
    start: CountOrZero
    stop: Annotated[int | None, Whole(0, also=(None,))]
    stride: Count
    check_consistency: Switch
    moving_px: Positive
    flow_files: Annotated[list[str], ListOf(OneOf(FLOW_FORMATS), least=0)]
    pictures_every: CountOrZero
    video: Switch
    video_fps: Positive
    rerun: Switch
    scale_px: FlowScale
    depth_range_m: Positive

    @model_validator(mode="after")
    def _has_a_pair(self) -> "FactorizeConfig":
        if self.stop is not None and self.stop < self.start + self.stride + 1:
            least = self.start + self.stride + 1
            raise broken_rule("stop", f"should be at least {least} for a pair, not {self.stop}")
        return self
