"""The sections `representations`, `flow` and `noise`: maps and their sources."""

from typing import Annotated, Any

from pydantic import model_validator

from flowrep.config.expectations import Count, Factor, NotNegative, OneOf, Positive, Share, Text
from flowrep.config.section import ChosenBy, Section
from flowrep.config.violations import broken_rule
from flowrep.transforms.estimated_flow import NETWORKS, PRESETS
from flowrep.transforms.flow import UNITS
from flowrep.transforms.maps import ENCODINGS
from flowrep.transforms.stack import FLOW_SOURCES

NOT_CHOSEN: Any = None


class Rgb(Section):
    """The picture, which has no options."""


class Segmentation(Section):
    """A class id per pixel."""

    encoding: Annotated[str, OneOf(ENCODINGS)]


class Depth(Section):
    """Distances."""

    range_m: Positive
    missing: Share


class Flow(Section):
    """Raw, ego or object flow."""

    scale: Annotated[float, Factor()]
    unit: Annotated[str, OneOf(UNITS)]


class SegmentationStack(Segmentation):
    """The same maps of the last `k` frames."""

    k: Count


class DepthStack(Depth):
    """The same maps of the last `k` frames."""

    k: Count


class Representations(Section):
    """What the agent sees: one or more, by name."""

    rgb: Rgb = NOT_CHOSEN
    seg: Segmentation = NOT_CHOSEN
    depth: Depth = NOT_CHOSEN
    raw: Flow = NOT_CHOSEN
    ego: Flow = NOT_CHOSEN
    obj: Flow = NOT_CHOSEN
    seg2: SegmentationStack = NOT_CHOSEN
    depth2: DepthStack = NOT_CHOSEN

    @model_validator(mode="after")
    def _is_not_empty(self) -> "Representations":
        if not self.model_fields_set:
            raise broken_rule("", "is empty; name one at least: representations=[ego,obj]")
        return self


class ExactFlow(Section):
    """`flow=exact`."""

    source: Annotated[str, OneOf(FLOW_SOURCES)]


class EstimatedFlow(ExactFlow):
    """`flow=estimated`."""

    estimator: Annotated[str, OneOf(("dis", *NETWORKS))]
    weights: Annotated[str | None, Text("a file of RAFT's weights", also=(None,))]
    preset: Annotated[str, OneOf(tuple(PRESETS))]
    min_side_px: Count

    @model_validator(mode="after")
    def _weights_are_rafts(self) -> "EstimatedFlow":
        if (self.estimator in NETWORKS) != (self.weights is not None):
            raise broken_rule(
                "weights",
                f"should be null with estimator={self.estimator}, not {self.weights!r}"
                if self.weights
                else f"is missing: estimator={self.estimator} needs flow.weights=<file>",
            )
        return self


class Noise(Section):
    """Errors of the depth camera and of odometry."""

    depth_sigma_per_m: NotNegative
    depth_dropout: Share
    drift_m: NotNegative
    drift_rad: NotNegative


BY_SOURCE = ChosenBy("source", {"estimated": EstimatedFlow}, otherwise=ExactFlow)
