"""The agents that `policy=` names in `flowrep.view` and `flowrep.evaluate`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowrep import pretrained
from flowrep.baselines import BASELINES
from flowrep.config import UsageError
from flowrep.config.schema import EnvConfig, ExactFlow, Noise
from flowrep.experiment.agents import Agent, load_external, load_trained
from flowrep.experiment.run import RunFolder


def load_agent(
    name: str,
    *,
    scene: Mapping[str, Any] | None,
    representations: Mapping[str, Any] | None = None,
    flow: Any = None,
    motion: str | None = None,
    noise: Noise | None = None,
    algorithm: str | None = None,
    **machine: Any,
) -> Agent:
    """Returns the agent that `policy=` names, in a scene, or in its run's own if None.

    It is a baseline, "pretrained", the folder of a run, or a policy of the user's own, for which
    `representations` are needed; None is exact flow and motion, and no noise. `algorithm` is one
    that a run may name besides flowrep's own. `machine` is `device`, `num_envs` and `num_workers`.
    """
    is_baseline, is_own = name in BASELINES, ":" in name or name.endswith(".pt2")
    if name == "pretrained":
        return pretrained.load(scene or {}, **machine)
    if Path(name).is_dir() and not is_baseline:
        return load_trained(RunFolder.existing(name), scene=scene, algorithm=algorithm, **machine)
    if not (is_baseline or is_own):
        raise UsageError(
            f"policy={name}: give {', '.join(BASELINES)}, pretrained, a run's folder, "
            "path.py:make, package.module:make or path.pt2"
        )
    if is_own and not representations:
        raise UsageError(f"representations needs a value for policy={name}")
    # not checked again: the values are of a command's config
    config = EnvConfig.model_construct(
        scene=scene,
        representations=representations if is_own else {},
        flow=flow or ExactFlow(source="exact"),
        motion=motion or "exact",
        noise=noise or Noise(**dict.fromkeys(Noise.model_fields, 0.0)),
        speed="normal",
        renderer="auto",
        seed=0,
        **machine,
    )
    return load_external(name, config) if is_own else Agent(name, config)
