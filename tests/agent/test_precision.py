import pytest
import torch

from flowrep.agent import precision


def test_auto_takes_bfloat16_where_it_is_fast(monkeypatch):
    cpu = torch.device("cpu")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    assert precision.compute_dtype("auto", cpu) is torch.bfloat16
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True})
    assert precision.compute_dtype("auto", cpu) is torch.float32
    assert precision.compute_dtype("bf16", cpu) is torch.bfloat16
    assert precision.compute_dtype("auto", torch.device("meta")) is torch.float32


def test_fp32_is_float32_everywhere(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    assert precision.compute_dtype("fp32", torch.device("cpu")) is torch.float32


def test_another_name_is_refused():
    with pytest.raises(ValueError, match="precision='half': expected one of auto, bf16, fp32"):
        precision.compute_dtype("half", torch.device("cpu"))
