"""Hydra configs of the env, the losses and the replay memory, in TorchRL's own config groups.

Importing this module registers them, with the transforms of `flowrep.transforms.hydra_configs`:

| group | names |
| --- | --- |
| `env` | `street` |
| `loss` | `discrete_sac_maps`, `discrete_sac_value_maps`, `double_dqn_maps`, `clip_ppo_maps` |
| `sampler` | `successor` |
| `storage` | `rows` |
| `replay_buffer` | `packed_maps` |
| `transform` | `pack_steps` |

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

from flowrep.extras import require

require("flowrep.torchrl_configs", "train", "hydra")

from torchrl.trainers.algorithms.configs.data import (
    ReplayBufferBaseConfig,
    SamplerConfig,
    StorageConfig,
)
from torchrl.trainers.algorithms.configs.envs import EnvConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from flowrep.agent import dqn, dsac, dsac_v, ppo, replay
from flowrep.envs import torchrl_env
from flowrep.transforms.hydra_configs import config_class, register

# By group and name.
CONFIGS: dict[tuple[str, str], type] = {
    ("env", "street"): config_class(torchrl_env.make_env, EnvConfig),
    ("loss", "discrete_sac_maps"): config_class(dsac.DiscreteSACMapLoss, LossConfig, partial=True),
    ("loss", "discrete_sac_value_maps"): config_class(
        dsac_v.DiscreteSACValueLoss, LossConfig, partial=True
    ),
    ("loss", "double_dqn_maps"): config_class(dqn.DoubleDQNMapLoss, LossConfig, partial=True),
    ("loss", "clip_ppo_maps"): config_class(ppo.ClipPPOMapLoss, LossConfig, partial=True),
    ("sampler", "successor"): config_class(replay.SuccessorSampler, SamplerConfig),
    ("storage", "rows"): config_class(replay.RowStorage, StorageConfig),
    ("replay_buffer", "packed_maps"): config_class(
        replay.ReplayMemory, ReplayBufferBaseConfig, partial=True
    ),
    ("transform", "pack_steps"): config_class(replay.PackSteps, TransformConfig, partial=True),
}

register(CONFIGS)
