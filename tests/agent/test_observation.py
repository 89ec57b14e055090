import pytest
import torch
import torch.nn.functional as F
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from flowrep.agent.class_convolution import one_hot
from flowrep.agent.observation import compute_dtype, map_codecs


def test_auto_takes_bfloat16_where_it_is_fast(monkeypatch):
    cpu = torch.device("cpu")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    assert compute_dtype("auto", cpu) is torch.bfloat16
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True})
    assert compute_dtype("auto", cpu) is torch.float32
    assert compute_dtype("bf16", cpu) is torch.bfloat16
    assert compute_dtype("auto", torch.device("meta")) is torch.float32


def test_fp32_is_float32_everywhere(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    assert compute_dtype("fp32", torch.device("cpu")) is torch.float32


def test_another_name_is_refused():
    with pytest.raises(ValueError, match="precision='half': expected one of auto, bf16, fp32"):
        compute_dtype("half", torch.device("cpu"))


def codec(spec, key="map", dtype=torch.float32):
    return map_codecs(Composite({key: spec}, shape=spec.shape[:-3]), [key], dtype)[0]


def test_a_pixel_goes_to_its_block_and_its_place_inside():
    c = codec(Unbounded((2, 36, 44)))
    x = torch.zeros(2, 36, 44)
    x[1, 5, 14] = 7.0
    packed = c.pack(x)
    assert packed.shape == (9, 11, 32)
    # row 5 = block 1, place 1; column 14 = block 3, place 2; channel 1: 1 * 16 + 1 * 4 + 2
    # (columns before rows would give 1 * 16 + 2 * 4 + 1 = 25)
    assert packed[1, 3, 22] == 7.0
    assert packed.count_nonzero() == 1


def test_rows_and_columns_that_no_kernel_reaches_are_left_out():
    # kernel 8, stride 4: 46 rows give outputs at 0, 4, ... 36, which end at row 43
    assert codec(Unbounded((1, 46, 39))).grid == (11, 9)


def by_hand(name, x):
    """What the network should see of a raw map: channel c * n + id is 1 where frame c shows id."""
    if name == "seg":
        return torch.stack(
            [(x[:, c] == i) for c in range(x.shape[1]) for i in range(4)], 1
        ).double()
    return x.double() / 255 if name == "rgb" else x.double()


@pytest.mark.parametrize("name", ["flow", "seg", "rgb", "seg2"])
def test_packed_convolution_equals_the_plain_one(name):
    torch.manual_seed(1)
    specs = {
        "flow": Unbounded((3, 2, 38, 45)),
        "seg": Categorical(4, (3, 1, 38, 45), dtype=torch.uint8),
        "rgb": Bounded(0, 255, (3, 3, 38, 45), dtype=torch.uint8),
        "seg2": Categorical(4, (3, 2, 38, 45), dtype=torch.uint8),
    }
    spec = specs[name]
    c, x = codec(spec), spec.rand()
    seen = by_hand(name[:3] if name == "seg2" else name, x)
    weight = torch.randn(5, seen.shape[1], 8, 8, dtype=torch.float64)
    assert c.network_channels == seen.shape[1]
    decoded = c.decode(c.pack(x))
    assert decoded.is_contiguous(memory_format=torch.channels_last)
    if c.num_classes:
        decoded = one_hot(decoded, c.num_classes, torch.float64)
    packed = F.conv2d(decoded.double(), c.pack_weight(weight), stride=1)
    torch.testing.assert_close(packed, F.conv2d(seen, weight, stride=4), rtol=1e-5, atol=1e-5)


def test_an_id_that_is_no_class_is_all_zeros_and_the_others_are_as_ever():
    spec = Categorical(4, (3, 2, 38, 45), dtype=torch.uint8)
    c, x = codec(spec, dtype=torch.bfloat16), spec.rand()
    expected = one_hot(c.decode(c.store(x)), 4, torch.bfloat16)
    x[1, 1, 6, 9], x[2, 0, 30, 3] = 255, 4
    # row 6 = block 1, place 2; column 9 = block 2, place 1; frame 1: (16 + 2 * 4 + 1) * 4 classes
    expected[1, 100:104, 1, 2] = 0
    expected[2, 44:48, 7, 0] = 0  # row 30 = block 7, place 2; column 3 = block 0, place 3; frame 0
    seen = one_hot(c.decode(c.store(x)), 4, torch.bfloat16)
    assert seen.dtype is torch.bfloat16
    assert torch.equal(seen, expected)


def test_any_leading_batch_packs_like_a_loop():
    c = codec(Unbounded((2, 38, 45)))
    x = torch.randn(2, 3, 2, 38, 45)
    looped = torch.stack([torch.stack([c.pack(image) for image in row]) for row in x])
    assert torch.equal(c.pack(x), looped)


@pytest.mark.parametrize("shape", [(3, 2, 42, 45), (3, 2, 38, 47), (3, 1, 38, 45), (38, 45)])
def test_a_map_of_another_size_is_not_stored(shape):
    c = codec(Unbounded((2, 38, 45)))
    # rows 38 and 42 both make 9 blocks, so that packing alone would cut the larger map
    with pytest.raises(ValueError, match=r"'map': .* built for maps \(2, 38, 45\), got \("):
        c.store(torch.zeros(shape))


def test_stored_types_are_compact():
    assert codec(Categorical(4, (1, 40, 40), dtype=torch.int64)).stored_dtype is torch.uint8
    assert codec(Bounded(0, 255, (3, 40, 40), dtype=torch.uint8)).stored_dtype is torch.uint8
    assert codec(Unbounded((2, 40, 40))).stored_dtype is torch.float16
    assert codec(Unbounded((2, 40, 40)), dtype=torch.bfloat16).stored_dtype is torch.bfloat16


def test_numbers_beyond_float16_saturate_instead_of_becoming_infinite():
    c = codec(Unbounded((1, 36, 36)))
    compact = c.compact(torch.tensor([1e6, -1e6, 2.5]))
    assert compact.tolist() == [65504.0, -65504.0, 2.5]


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
def test_a_spec_that_cannot_be_read_says_why(spec, message):
    with pytest.raises(ValueError, match=message):
        map_codecs(Composite(map=spec), ["map"], torch.float32)


def test_a_missing_key_lists_what_there_is():
    spec = Composite(ego=Unbounded((2, 40, 40)))
    with pytest.raises(KeyError, match=r"reads 'obj'; the environment offers \['ego'\]"):
        map_codecs(spec, ["obj"], torch.float32)
    with pytest.raises(ValueError, match="at least one"):
        map_codecs(spec, [], torch.float32)


def test_nested_keys_are_read():
    spec = Composite(view=Composite(ego=Unbounded((2, 40, 40))))
    assert map_codecs(spec, [("view", "ego")], torch.float32)[0].channels == 2
