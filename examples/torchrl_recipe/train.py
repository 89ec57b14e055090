"""TorchRL's own trainer on a street, put together from config groups alone.

pip install '.[train]'
python examples/torchrl_recipe/train.py trainer.total_frames=100000
"""

import hydra
from torchrl.trainers.algorithms.configs import *  # noqa: F403 - registers TorchRL's groups


@hydra.main(config_path=".", config_name="config", version_base="1.3")
def main(config):
    hydra.utils.instantiate(config.trainer).train()


if __name__ == "__main__":
    main()
