"""flowrep's parts in TorchRL's Collector and Trainer: a run in two pieces is the run in one."""

from pathlib import Path

import pytest
import torch

pytest.importorskip("pybullet", reason="the streets are simulated in PyBullet")

from examples.torchrl_trainer import train
from tests.comparing import differing

SMALL = {"num_envs": 2, "side": 36, "batch_size": 8, "capacity": 200}


@pytest.mark.slow
def test_a_run_in_two_pieces_is_the_run_in_one_bit_for_bit(tmp_path):
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    train(whole, 160, **SMALL)
    train(pieces, 60, **SMALL)
    first = torch.load(pieces, weights_only=True)
    train(pieces, 160, **SMALL)
    once, twice = (torch.load(file, weights_only=True) for file in (whole, pieces))
    assert differing(once, twice) == []
    assert once["state"]["collected_frames"] == 160
    # updates changed what the policy and the targets read
    changed = {place.split("/")[2].split(".")[0] for place in differing(first, once)}
    assert {"critic_encoder_params", "target_critic_encoder_params"} <= changed


@pytest.mark.slow
def test_torchrls_trainer_runs_from_config_groups_alone(tmp_path):
    import hydra
    import torchrl.trainers.algorithms.configs  # noqa: F401 - registers its groups

    recipe = Path(__file__).parents[2] / "examples" / "torchrl_recipe"
    small = ["trainer.total_frames=96", "trainer.optim_steps_per_batch=1", "trainer.log_interval=1",
             "street.num_envs=2", "collector.frames_per_batch=32", "memory.batch_size=4",
             "collector.init_random_frames=32", f"logger.log_dir={tmp_path}",
             "trainer.progress_bar=false"]  # fmt: skip
    with hydra.initialize_config_dir(str(recipe), version_base="1.3"):
        config = hydra.compose("config", small)
    trainer = hydra.utils.instantiate(config.trainer)
    before = [weight.clone() for weight in trainer.loss_module.parameters()]
    trainer.train()
    assert trainer.collected_frames == 96
    after = trainer.loss_module.parameters()
    assert any(not a.equal(b) for a, b in zip(after, before))
    assert list(tmp_path.rglob("*.csv"))
