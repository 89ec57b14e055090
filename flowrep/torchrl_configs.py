"""Hydra configs of the env, the losses and the replay memory, in TorchRL's own config groups.

Importing this module registers `CONFIGS`, and the transforms of `flowrep.transforms.hydra_configs`.

```yaml
defaults:
  - env@env: street
  - loss@loss: discrete_sac_maps
  - replay_buffer@memory: packed_maps
  - _self_

env: {representations: [ego, obj], num_envs: 4}
loss: {gamma: 0.97, initial_alpha: 0.05}
memory: {capacity: 50_000, batch_size: 256, device: cpu, n_steps: 3, gamma: 0.97}
```

Configs of classes that take a network or codecs, which a config can't hold, are partial:
`instantiate` returns a function of these arguments, as in
`instantiate(config.loss)(network, actions)` and `instantiate(config.memory)(network.codecs)`. Names
and defaults come from the signatures.
"""

from __future__ import annotations

from typing import Any

from flowrep.extras import require

require("flowrep.torchrl_configs", "train", "hydra")

from torchrl.trainers.algorithms.configs import data, envs, objectives, transforms

from flowrep.agent import dqn, dsac, dsac_v, ppo, replay
from flowrep.envs import torchrl_env
from flowrep.transforms.hydra_configs import config_class, register

# group, name, what is made, TorchRL's base, and whether a network or codecs are still to be given
_TABLE: tuple[tuple[str, str, Any, type, bool], ...] = (
    ("env", "street", torchrl_env.make_env, envs.EnvConfig, False),
    ("loss", "discrete_sac_maps", dsac.DiscreteSACMapLoss, objectives.LossConfig, True),
    ("loss", "discrete_sac_value_maps", dsac_v.DiscreteSACValueLoss, objectives.LossConfig, True),
    ("loss", "double_dqn_maps", dqn.DoubleDQNMapLoss, objectives.LossConfig, True),
    ("loss", "clip_ppo_maps", ppo.ClipPPOMapLoss, objectives.LossConfig, True),
    ("sampler", "successor", replay.SuccessorSampler, data.SamplerConfig, False),
    ("storage", "rows", replay.RowStorage, data.StorageConfig, False),
    ("replay_buffer", "packed_maps", replay.ReplayMemory, data.ReplayBufferBaseConfig, True),
    ("transform", "pack_steps", replay.PackSteps, transforms.TransformConfig, True),
)
CONFIGS = {
    (group, name): config_class(made, base, partial=partial)
    for group, name, made, base, partial in _TABLE
}
register(CONFIGS)
