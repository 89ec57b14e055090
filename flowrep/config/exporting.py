"""The config of `flowrep.export`, conf/export.yaml."""

from typing import Annotated

from pydantic import Field

from flowrep.config.expectations import Text
from flowrep.config.section import Section
from flowrep.config.training import Path, Trust


class ExportConfig(Section):
    """The whole config of an export."""

    run: Annotated[str, Text("a run folder")] = Field(examples=["outputs/..."])
    output: Path
    trust: Trust
