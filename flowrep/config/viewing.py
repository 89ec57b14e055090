"""The config of `flowrep.view`, conf/view.yaml."""

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from flowrep.baselines.baselines import BASELINES
from flowrep.config.expectations import Count, OneOf, Seed, Switch, Text
from flowrep.config.section import Section
from flowrep.config.training import FRAME_RATE, SceneSection, Speed


class ViewConfig(Section):
    """The whole config of a look at a scene."""

    scene: SceneSection = Field(examples=["straight_road"])
    policy: Annotated[str, OneOf(tuple(BASELINES))]
    speed: Speed
    frame_rate_hz: Annotated[float | None, replace(FRAME_RATE, also=(None,))]
    path: Annotated[str | None, Text("the name of a path of the scene", also=(None,))]
    seed: Seed
    episodes: Count
    sheet_rows: Count
    video: Switch
    interactive: Switch
