"""Hydra configs of the transforms, in TorchRL's config group `transform`.

Importing this module registers them and those of `torchrl.trainers.algorithms.configs`:

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
key, `in_keys: [a, b]` are two. Argument names and defaults are those of the constructors.
"""

from __future__ import annotations

import importlib
import inspect
import re
from typing import Any

from flowrep.extras import require

require("flowrep.transforms.hydra_configs", "train", "hydra")

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torchrl.envs.transforms import Transform

from flowrep import transforms
from flowrep.transforms.base import as_keys


def config_of(transform: type[Transform]) -> dict[str, Any]:
    """Returns a transform's class and arguments; one without a default is `???`, mandatory."""
    # TorchRL's metaclass hides the signature of the constructor.
    parameters = inspect.signature(transform.__init__).parameters
    arguments = {name: _plain(name, p.default) for name, p in parameters.items() if name != "self"}
    # The transform gets lists and mappings as Python's types, not as OmegaConf's.
    target = {"_target_": f"{transform.__module__}.{transform.__qualname__}", "_convert_": "all"}
    return target | arguments


def _plain(name: str, default: Any) -> Any:
    if default is inspect.Parameter.empty:
        return MISSING
    if name in ("in_keys", "out_keys") and default is not None:
        return [key if isinstance(key, str) else [*key] for key in as_keys(default)]
    return [*default] if isinstance(default, tuple) else default


importlib.import_module("torchrl.trainers.algorithms.configs")  # registers TorchRL's
CONFIGS: dict[str, dict[str, Any]] = {}
"""The configs by their names in the group `transform`: `raw_flow` for `RawFlow`."""

for _name in transforms.__all__:
    _class = getattr(transforms, _name)
    if isinstance(_class, type) and issubclass(_class, Transform):
        snake_case = re.sub(r"(?<!^)(?=[A-Z])", "_", _name).lower()
        CONFIGS[snake_case] = config_of(_class)
        ConfigStore.instance().store(
            group="transform", name=snake_case, node=CONFIGS[snake_case], provider="flowrep"
        )
