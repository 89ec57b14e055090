"""flowrep's parts in TorchRL's Collector and Trainer: a run in two pieces is the run in one."""

import pytest
import torch

pytest.importorskip("pybullet", reason="the streets are simulated in PyBullet")

from examples.torchrl_trainer import train

SMALL = {"num_envs": 2, "side": 36, "batch_size": 8}


def differing(a, b, place=""):
    """Names every leaf in which two nested states differ."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), place
        return [d for key in a for d in differing(a[key], b[key], f"{place}/{key}")]
    if isinstance(a, list | tuple):
        pairs = enumerate(zip(a, b, strict=True))
        return [d for i, pair in pairs for d in differing(*pair, f"{place}/{i}")]
    same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    return [] if same else [place]


@pytest.mark.slow
def test_a_run_in_two_pieces_is_the_run_in_one_bit_for_bit(tmp_path):
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    train(whole, 240, **SMALL)
    train(pieces, 100, **SMALL)
    first = torch.load(pieces, weights_only=True)
    train(pieces, 240, **SMALL)
    once, twice = (torch.load(file, weights_only=True) for file in (whole, pieces))
    assert differing(once, twice) == []
    assert once["state"]["collected_frames"] == 240
    # updates changed what the policy and the targets read
    changed = {place.split("/")[2].split(".")[0] for place in differing(first, once)}
    assert {"critic_encoder_params", "target_critic_encoder_params"} <= changed
