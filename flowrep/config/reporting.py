"""The config of `flowrep.report`, conf/report.yaml."""

from typing import Annotated, Any

from pydantic import Field

from flowrep.config.evaluating import POLICIES
from flowrep.config.expectations import Count, CountOrZero, ListOf, OneOf, Text
from flowrep.config.section import Section
from flowrep.config.training import Path


class ReportConfig(Section):
    """The whole config of a report."""

    run: Annotated[Any, ListOf(Text("a run folder, or a sweep's"), or_one=True)] = Field(
        examples=["outputs/..."]
    )
    output: Path
    policy: Annotated[str, OneOf(POLICIES)]
    resamples: Count
    trajectories: CountOrZero
    videos: CountOrZero
