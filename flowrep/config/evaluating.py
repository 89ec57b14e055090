"""The config of `flowrep.evaluate`, conf/evaluate.yaml."""

from typing import Annotated, Any

from pydantic import model_validator

from flowrep.config.expectations import Count, CountOrZero, ListOf, Number, OneOf, Seed, Text
from flowrep.config.section import Section
from flowrep.config.training import (
    SPEEDS,
    Device,
    SceneSection,
    Trust,
    Workers,
    check_workers,
)
from flowrep.drivers.baselines import BASELINES

POLICIES = ("greedy", "sampled")


class EvaluateConfig(Section):
    """The whole config of an evaluation."""

    run: Annotated[Any, ListOf(Text("a run folder, or a sweep's"), or_one=True)]
    scene: SceneSection | None = None
    speed: Annotated[Any, ListOf(OneOf(SPEEDS), or_one=True)]
    fps: Annotated[Any, ListOf(Number(above=0), or_one=True)]
    episodes: Count
    policy: Annotated[Any, ListOf(OneOf(POLICIES), or_one=True)]
    baselines: Annotated[Any, ListOf(OneOf(tuple(BASELINES)), least=0, or_one=True)]
    seed: Seed
    num_envs: Count
    num_workers: Workers
    device: Device
    trust: Trust
    video: CountOrZero

    @model_validator(mode="after")
    def _fits_together(self) -> "EvaluateConfig":
        check_workers(self.num_workers, self.num_envs)
        return self
