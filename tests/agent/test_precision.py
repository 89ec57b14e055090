import pytest
import torch

from flowrep.agent import precision


def test_precision_auto_is_bfloat16_where_that_is_faster(monkeypatch):
    cpu = torch.device("cpu")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    for faster, dtype in ((True, torch.bfloat16), (False, torch.float32)):
        monkeypatch.setattr(precision, "_bf16_products_are_faster", lambda faster=faster: faster)
        assert precision.compute_dtype("auto", cpu) is dtype
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True})
    assert precision.compute_dtype("auto", cpu) is torch.float32
    assert not precision.has_bf16(cpu)
    assert precision.compute_dtype("bf16", cpu) is torch.bfloat16
    assert precision.compute_dtype("auto", torch.device("meta")) is torch.float32
    assert precision.compute_dtype("fp32", cpu) is torch.float32
    with pytest.raises(ValueError, match="precision='half'"):
        precision.compute_dtype("half", cpu)
