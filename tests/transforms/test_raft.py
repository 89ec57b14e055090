"""RAFT: sizes, padding, scaling and weights, by a network whose answer is known."""

from __future__ import annotations

import types

import pytest
import torch
from torch import nn

from flowrep.transforms import RAFT, EstimatedFlow, estimated_flow


class KnownNetwork(nn.Module):
    """Says that all went 12 px right and 6 px up; keeps what it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.0))
        self.shown: list[torch.Tensor] = []

    def forward(self, first, second, num_flow_updates):
        self.shown = [first, second]
        motion = self.factor * torch.tensor([12.0, -6.0]).reshape(1, 2, 1, 1)
        wrong = torch.zeros(len(first), 2, *first.shape[-2:])
        return [wrong] * (num_flow_updates - 1) + [wrong + motion]


@pytest.fixture
def weights(tmp_path, monkeypatch):
    network = types.SimpleNamespace(raft_small=lambda weights: KnownNetwork())
    monkeypatch.setattr(estimated_flow, "_optical_flow", lambda: network)
    path = tmp_path / "weights.pth"
    torch.save({"factor": torch.tensor(1.0)}, path)
    return path


def test_small_pictures_are_enlarged_and_their_flow_scaled_back(weights):
    # 50 x 84 needs a factor of 3 to reach 128: 150 x 252, padded to 152 x 256; 12 px become 4.
    estimator = RAFT(weights)
    first, second = torch.zeros(2, 2, 3, 50, 84, dtype=torch.uint8)
    second += 255
    flow = estimator(first, second)
    assert flow.shape == (2, 2, 50, 84)
    assert flow[0, :, 7, 9].tolist() == [4.0, -2.0]
    assert [picture.shape[-2:] for picture in estimator.network.shown] == [(152, 256)] * 2
    assert [picture.unique().tolist() for picture in estimator.network.shown] == [[-1.0], [1.0]]


def test_what_is_padded_is_cut_off_again(weights):
    # 129 x 140 is padded to 136 x 144 on the right and below: the first corner stays where it is.
    picture = torch.zeros(1, 3, 129, 140, dtype=torch.uint8)
    picture[..., 0, 0] = 255
    estimator = RAFT(weights)
    assert estimator(picture, picture).shape == (1, 2, 129, 140)
    (shown, _) = estimator.network.shown
    assert shown.shape == (1, 3, 136, 144)
    assert (shown == 1).nonzero()[:, 2:].tolist() == [[0, 0]] * 3


def test_large_pictures_keep_their_size(weights):
    pictures = torch.zeros(1, 3, 128, 136, dtype=torch.uint8)
    estimator = RAFT(weights)
    assert estimator(pictures, pictures)[0, :, 0, 0].tolist() == [12.0, -6.0]
    assert estimator.network.shown[0].shape == (1, 3, 128, 136)


def test_raw_flow_is_its_answer_negated(weights):
    pair = torch.zeros(6, 40, 50, dtype=torch.uint8)
    pair[3:] = 1
    transform = EstimatedFlow("raft_small", weights=weights).train()
    assert transform.compute(pair)[0][:, 0, 0].tolist() == [-3.0, 1.5]  # a factor of 4: 160 px
    assert not any(module.training for module in transform.estimator.modules())


def test_safetensors_are_read_too(weights):
    safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")
    path = weights.with_suffix(".safetensors")
    safetensors.save_file({"factor": torch.tensor(2.0)}, path)
    pictures = torch.zeros(1, 3, 128, 128, dtype=torch.uint8)
    assert RAFT(path)(pictures, pictures)[0, :, 0, 0].tolist() == [24.0, -12.0]


def test_what_is_no_weights_is_refused_by_name(weights, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no RAFT weights at '.*nowhere\.pth'"):
        RAFT(tmp_path / "nowhere.pth")
    other = tmp_path / "other.pth"
    torch.save({"bias": torch.zeros(1)}, other)
    with pytest.raises(ValueError, match=r"other\.pth does not hold the weights of raft_small"):
        RAFT(other)
    with pytest.raises(ValueError, match=r"\['raft_small', 'raft_large'\], got 'raft_tiny'"):
        RAFT(weights, "raft_tiny")
    with pytest.raises(ValueError, match="at least 128"):
        RAFT(weights, min_side_px=96)


class Planted:
    """Would run code if it were unpickled."""

    def __reduce__(self):
        return print, ("unpickled",)


def test_weights_are_read_without_running_what_is_in_them(weights, capsys):
    torch.save({"factor": Planted()}, weights)
    with pytest.raises(Exception, match=r"[Ww]eights"):
        RAFT(weights)
    assert "unpickled" not in capsys.readouterr().out


def test_torchvisions_network_takes_small_pictures(tmp_path):
    try:
        from torchvision.models.optical_flow import raft_small
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"no torchvision for this torch ({str(error).splitlines()[0]})")
    path = tmp_path / "random.pth"
    torch.save(raft_small(weights=None).state_dict(), path)
    pictures = torch.randint(0, 256, (2, 2, 3, 40, 52), dtype=torch.uint8)
    flow = RAFT(path, updates=2)(*pictures)
    assert flow.shape == (2, 2, 40, 52)
    assert flow.isfinite().all()


@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
@pytest.mark.parametrize("content", [b"", b"garbage", bytes(1000), b"\x80\x05cos\nsystem\n."])
def test_weights_that_are_garbage_are_named_without_advice_to_trust_them(tmp_path, name, content):
    pytest.importorskip("safetensors")
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"'{path}' is not a readable weights file") as caught:
        RAFT(path)
    assert "weights_only" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_weights_that_are_no_state_dict_are_named(tmp_path):
    torch.save([torch.ones(2)], tmp_path / "w.pth")
    with pytest.raises(ValueError, match="holds no state dict"):
        RAFT(tmp_path / "w.pth")
