"""flowrep's parts in TorchRL's Collector and Trainer: a run in two pieces is the run in one."""

import pytest
import torch

from examples.torchrl_trainer import train
from tests.comparing import differing

SMALL = {"num_envs": 2, "side": 36, "batch_size": 8, "capacity": 200}


@pytest.mark.slow
def test_a_run_in_two_pieces_is_the_run_in_one_bit_for_bit(tmp_path):
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    train(whole, 80, **SMALL)
    train(pieces, 40, **SMALL)
    first = torch.load(pieces, weights_only=True)
    train(pieces, 80, **SMALL)
    once, twice = (torch.load(file, weights_only=True) for file in (whole, pieces))
    assert differing(once, twice) == []
    assert once["state"]["collected_frames"] == 80
    # updates changed what the policy and the targets read
    changed = {place.split("/")[2].split(".")[0] for place in differing(first, once)}
    assert {"critic_encoder_params", "target_critic_encoder_params"} <= changed
