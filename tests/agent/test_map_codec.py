import re

import pytest
import torch
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from flowrep.agent.map_codec import map_codecs


def codec(spec, key="map", dtype=torch.float32):
    return map_codecs(Composite({key: spec}, shape=spec.shape[:-3]), [key], dtype)[0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("batch", [(3,), (2, 1)])
def test_floats_are_stored_in_two_bytes_and_intensities_seen_as_shares_of_255(dtype, batch):
    flow, rgb = torch.randn(*batch, 2, 38, 45), torch.randint(256, (*batch, 3, 38, 45)).byte()
    c = codec(Unbounded((2, 38, 45)), dtype=dtype)
    stored = c.store(flow)
    assert stored.dtype is (torch.bfloat16 if dtype is torch.bfloat16 else torch.float16)
    assert torch.equal(stored, flow.to(stored.dtype))
    seen = c.decode(stored.flatten(0, -4))
    assert seen.dtype is dtype
    assert seen.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(seen, stored.flatten(0, -4).to(dtype))
    c = codec(Bounded(0, 255, (3, 38, 45), dtype=torch.uint8), dtype=dtype)
    assert torch.equal(c.store(rgb), rgb)
    assert torch.equal(c.decode(rgb.flatten(0, -4)), rgb.flatten(0, -4).to(dtype) / 255)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_class_ids_become_one_hot_frame_by_frame_and_unknown_ids_zeros(dtype):
    c = codec(Categorical(4, (2, 38, 45), dtype=torch.int64), dtype=dtype)
    ids = torch.randint(4, (3, 2, 38, 45))
    ids[1, 1, 6, 9], ids[2, 0, 30, 3] = 255, 4
    stored = c.store(ids)
    assert stored.dtype is torch.uint8
    # channel c * n + id is 1 where frame c shows id
    expected = torch.stack([ids[:, c] == i for c in range(2) for i in range(4)], 1)
    seen = c.decode(stored)
    assert (seen.shape[1], seen.dtype) == (c.network_channels, dtype)
    assert seen.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(seen, expected.to(dtype))


def test_numbers_beyond_float16_saturate_instead_of_becoming_infinite():
    c = codec(Unbounded((1, 36, 36)))
    for value, expected in ((1e6, 65504.0), (-1e6, -65504.0), (2.5, 2.5)):
        assert (c.store(torch.full((1, 36, 36), value)) == expected).all()


@pytest.mark.parametrize("shape", [(3, 2, 42, 45), (3, 1, 38, 45), (38, 45)])
def test_a_map_of_another_size_is_not_stored(shape):
    with pytest.raises(ValueError, match=r"'map': .*\(2, 38, 45\)"):
        codec(Unbounded((2, 38, 45))).store(torch.zeros(shape))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded((2, 35, 80)), "35x80: the Nature encoder needs at least 36x36"),
        (Unbounded((7,)), r"expected a map \[..., C, H, W\], got shape \(7,\)"),
        (Bounded(0, 7, (1, 40, 40), dtype=torch.uint8), "ids or intensities"),
        (Unbounded((1, 40, 40), dtype=torch.int64), "dtype torch.int64"),
        (Categorical(300, (1, 40, 40)), "300 classes"),
    ],
)
def test_a_spec_that_no_codec_fits_is_refused_with_the_reason(spec, message):
    with pytest.raises(ValueError, match=message):
        map_codecs(Composite(map=spec), ["map"], torch.float32)


def test_keys_may_be_nested_and_a_missing_key_is_refused_with_those_there_are():
    spec = Composite(view=Composite(ego=Unbounded((2, 40, 40))))
    assert map_codecs(spec, [("view", "ego")], torch.float32)[0].channels == 2
    with pytest.raises(KeyError, match=r"reads 'obj'; the environment offers .*'ego'"):
        map_codecs(spec, ["obj"], torch.float32)
    for keys in ([], "obj"):  # not the keys 'o', 'b' and 'j'
        with pytest.raises(ValueError, match=f"list .*, got {re.escape(repr(keys))}"):
            map_codecs(spec, keys, torch.float32)
