"""Hydra configs of the transforms, in TorchRL's own config group `transform`.

Importing this module registers them, beside those of `torchrl.trainers.algorithms.configs`:

```yaml
defaults:
  - transform@raw: raw_flow
  - transform@split: flow_factorize
  - transform@stack: compose  # TorchRL's
  - _self_

raw: {intrinsics: [sensor, K]}
split: {intrinsics: [sensor, K], outputs: [obj]}
stack: {transforms: ["${raw}", "${split}"]}
```

As in TorchRL's configs, a nested key is a list within the list of keys: `in_keys: [[a, b]]` is one
key, `in_keys: [a, b]` are two. Names and defaults come from the signatures of the classes.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torchrl.envs.transforms import Transform
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from flowrep import transforms
from flowrep.extras import require
from flowrep.transforms.base import as_keys

require("flowrep.transforms.hydra_configs", "train", "hydra")


def config_class(
    target: Callable[..., Any], base: type = TransformConfig, *, partial: bool = False
) -> Any:
    """Returns the config of a class or function: a dataclass with a field for each parameter.

    `base` is TorchRL's config class of the group; with `partial`, Hydra returns a function of the
    arguments that are still missing.
    """
    # TorchRL's metaclasses hide the constructor's signature.
    made_by = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    fields: list[tuple[str, Any, Any]] = [
        (name, Any, _field(name, parameter.default))
        for name, parameter in inspect.signature(made_by).parameters.items()
        if name != "self"
    ]
    place = f"{target.__module__}.{target.__qualname__}"
    # Lists and mappings reach the target as Python's own types, not as OmegaConf's.
    fields += [("_target_", str, place), ("_convert_", str, "all"), ("_partial_", bool, partial)]
    return dataclasses.make_dataclass(
        f"{target.__name__}Config",
        fields,
        bases=(base,),
        namespace={"__doc__": f"Configuration of `{place}`.", "__module__": __name__},
    )


def _field(name: str, default: Any) -> Any:
    if default is inspect.Parameter.empty:
        return MISSING
    if name in ("in_keys", "out_keys") and default is not None:
        default = [key if isinstance(key, str) else [*key] for key in as_keys(default)]
    if isinstance(default, (tuple, list)):
        return dataclasses.field(default_factory=lambda: [*default])
    return default


# By name in the group `transform`: `raw_flow` for `RawFlow`.
CONFIGS: dict[str, type[TransformConfig]] = {
    re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower(): config_class(getattr(transforms, name))
    for name in transforms.__all__
    if isinstance(getattr(transforms, name), type)
    and issubclass(getattr(transforms, name), Transform)
}
# `RawFlowConfig` and the others by name, too, as pickle looks classes up.
globals().update({config.__name__: config for config in CONFIGS.values()})


def register(configs: Mapping[tuple[str, str], type]) -> None:
    """Stores configs by group and name; importing a module with configs calls this."""
    store = ConfigStore.instance()
    for (group, name), config in configs.items():
        store.store(group=group, name=name, node=config, provider="flowrep")


register({("transform", name): config for name, config in CONFIGS.items()})
