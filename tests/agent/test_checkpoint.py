import os
import pickle

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from flowrep.agent import CheckpointError, checkpoint, load_checkpoint, save_checkpoint
from tests.comparing import differing


def test_every_kind_of_value_comes_back_as_it_was_in_a_file_like_others(tmp_path):
    shared, (zero, one, two) = torch.arange(12).reshape(3, 4), torch.arange(3)
    state = {
        "weights": {"conv.weight": torch.randn(2, 3), "half": torch.randn(3).half()},
        "transposed": shared.t(), "row": shared[1], "tied": [shared, shared],
        "nothing": torch.empty(0, 2), "scalar": torch.tensor(True),
        "bf16": torch.randn(2).bfloat16(),
        "updates": 7, "alpha": 0.1 + 0.2, "bounds": [float("-inf"), float("inf"), 1e-300],
        "flag": False, "missing": None, "rng": {"state": [3, 2**70, None], "name": "PCG64"},
        "tensor": {"tensor": "a dict that looks like a reference"},
        # names that collide if they are joined
        "a/b": zero, "a": {"b": one}, "": {"a": {"b": two}, "empty key": []},
    }  # fmt: skip
    (tmp_path / "plain").touch()
    path = tmp_path / "new folder" / "c.safetensors"
    save_checkpoint(path, state)
    assert differing(load_checkpoint(path), state) == []
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode  # others may read it
    assert os.listdir(path.parent) == ["c.safetensors"]


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"a": {"b": object()}}, r"checkpoint\['/a/b'\] is a object"),
        ({"a": [1, {2}]}, r"checkpoint\['/a/1'\] is a set"),
        ({"a": {0: 1}}, r"checkpoint\['/a'\] is a dict"),
    ],
)
def test_what_cannot_be_kept_is_named_by_its_place(tmp_path, state, message):
    with pytest.raises(TypeError, match=message):
        save_checkpoint(tmp_path / "c", state)
    assert not list(tmp_path.iterdir())


STATE = {"weights": {"w": torch.arange(6.0).reshape(2, 3)}, "flags": torch.ones(3, dtype=bool)}


def truncated(path):
    save_checkpoint(path, STATE)
    path.write_bytes(path.read_bytes()[:-10])


def with_metadata(**metadata):
    return lambda path: save_file({"a": torch.ones(2)}, path, metadata=metadata or None)


DAMAGES = {
    "truncated": truncated,
    "pickle": lambda path: path.write_bytes(pickle.dumps({"a": 1})),
    "foreign": with_metadata(),
    "other version": with_metadata(format="flowrep checkpoint 2", state="{}"),
    "missing": lambda path: None,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=list(DAMAGES))
def test_a_file_that_is_no_checkpoint_is_named(tmp_path, damage):
    path = tmp_path / "c.safetensors"
    damage(path)
    with pytest.raises(CheckpointError, match=r"c\.safetensors"):
        load_checkpoint(path)


def test_a_checkpoint_replaced_while_it_is_read_is_read_to_its_end(tmp_path, monkeypatch):
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, {"a": torch.zeros(3)})

    def replace_then_open(*args, **kwargs):
        save_checkpoint(path, {"of another length": 1, "a": torch.ones(5)})
        return safe_open(*args, **kwargs)

    monkeypatch.setattr(checkpoint, "safe_open", replace_then_open)
    assert load_checkpoint(path)["a"].tolist() == [0.0, 0.0, 0.0]


def test_a_folder_that_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(CheckpointError, match=r"file/c"):
        save_checkpoint(tmp_path / "file" / "c", {"a": 1})


def flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def loaded(path, *parts):
    try:
        return load_checkpoint(path, *parts)
    except CheckpointError:
        return None


def test_a_flipped_bit_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "c.safetensors"
    state = STATE | {"half": torch.ones(2).bfloat16(), "frames": 1234, "rate": 0.5, "none": None}
    save_checkpoint(path, state)
    data = path.read_bytes()
    for byte in range(len(data)):
        path.write_bytes(flipped(data, 8 * byte + byte % 8))
        found = loaded(path)
        is_harmless = found is None or differing(found, state) == []  # or in the header's padding
        assert is_harmless, byte
    tensors = 8 + int.from_bytes(data[:8], "little")  # where the header ends
    for bit in range(8 * tensors, 8 * len(data)):
        path.write_bytes(flipped(data, bit))
        assert loaded(path) is None, bit


def test_a_damaged_part_does_not_keep_others_from_being_read(tmp_path):
    """An agent is read without the gigabytes of a replay memory."""
    path = tmp_path / "c.safetensors"
    memory, weight = (torch.full((50,), n, dtype=torch.uint8) for n in (7, 9))
    save_checkpoint(path, {"memory": memory, "policy": {"weight": weight}, "frames": 3})
    data = path.read_bytes()
    path.write_bytes(flipped(data, 8 * data.index(bytes([7] * 50)) + 40))
    assert loaded(path) is None
    alone = {"policy": {"weight": weight}, "frames": 3}
    assert differing(loaded(path, ["policy", "frames"]), alone) == []
    path.write_bytes(flipped(data, 8 * data.index(bytes([9] * 50)) + 40))
    assert loaded(path, ["policy"]) is None
    assert loaded(path, ["frames"]) == {"frames": 3}
    with pytest.raises(CheckpointError, match="'critic'"):
        load_checkpoint(path, ["critic"])


def test_tensors_of_one_size_that_changed_places_are_noticed(tmp_path):
    path = tmp_path / "c.safetensors"
    save_checkpoint(
        path, {"a": torch.zeros(2, 3), "b": torch.zeros(3, 2), "c": torch.zeros(6).int()}
    )
    data = path.read_bytes()
    for old, new in ((b"[2,3]", b"[3,2]"), (b"I32", b"F32"), (b"[6]", b"[6]")):
        path.write_bytes(data.replace(old, new))
        assert (loaded(path) is None) == (old != new)
