"""The config of `flowrep.evaluate`, conf/evaluate.yaml."""

from typing import Annotated, Any

from pydantic import model_validator
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from flowrep.baselines.baselines import BASELINES
from flowrep.config.expectations import Count, CountOrZero, ListOf, OneOf, Seed, Text
from flowrep.config.representations import BY_SOURCE, Noise, Representations
from flowrep.config.section import Section
from flowrep.config.training import (
    FRAME_RATE,
    SPEEDS,
    Device,
    Path,
    SceneSection,
    Trust,
    Workers,
    check_workers,
)
from flowrep.config.violations import ABSENT, broken_rule
from flowrep.exchange.policies import is_reference

POLICIES = ("greedy", "sampled")
OF_OWN_POLICIES = ("representations", "flow", "noise", "output")


class Policy(OneOf):
    """One of some names, or the user's own policy."""

    def _schema(self) -> CoreSchema:
        text = core_schema.str_schema(strict=True)
        return core_schema.no_info_after_validator_function(self._is_one, text)

    def _is_one(self, value: str) -> str:
        if value not in self.choices and not is_reference(value):
            raise PydanticCustomError("policy", "is no policy")
        return value

    def _words(self) -> str:
        return f"{', '.join(self.choices)}, path.py:make, package.module:make or path.pt2"


class EvaluateConfig(Section):
    """The whole config of an evaluation."""

    run: Annotated[Any, ListOf(Text("a run folder, or a sweep's"), or_one=True, also=(None,))]
    scene: SceneSection | None = None
    representations: Representations | None = None
    flow: Annotated[Any, BY_SOURCE] = None
    noise: Noise | None = None
    speed: Annotated[Any, ListOf(OneOf(SPEEDS), or_one=True)]
    fps: Annotated[Any, ListOf(FRAME_RATE, or_one=True)]
    episodes: Count
    policy: Annotated[Any, ListOf(Policy(POLICIES), or_one=True)]
    output: Path
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
        asked = self.policy if isinstance(self.policy, list) else [self.policy]
        own = [name for name in asked if is_reference(name)]
        if own and len(own) < len(asked):
            raise broken_rule("policy", f"should be {', '.join(POLICIES)}, or your own, not both")
        if own:
            self._fits_own_policies(own[0])
        elif self.run is None:
            raise PydanticCustomError(ABSENT, "{example}", {"key": "run", "example": "..."})
        else:
            for key in OF_OWN_POLICIES:
                if getattr(self, key) is not None:
                    raise broken_rule(key, "is for a policy of your own; run= has it in its config")
        return self

    def _fits_own_policies(self, name: str) -> None:
        """Checks that the scene and the observations of a policy are given."""
        if self.run is not None:
            raise broken_rule("run", f"and policy={name} can't be combined: give one of them")
        for key, example in (("scene", "straight_road"), ("representations", "[ego,obj]")):
            if getattr(self, key) is None:
                raise broken_rule(key, f"is needed for policy={name}: {key}={example}")
