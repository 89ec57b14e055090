"""Saves and loads checkpoints: tensors and plain data in one file, written atomically.

`experiment.runner` saves one every `checkpoint_every_frames`, in place of the last.

The file is a safetensors file. The metadata in its header hold a JSON document that mirrors the
nested state, with each tensor as `{"tensor": name}` and each dict as `{"dict": items}`. Nothing in
it can run code. `torchrl.checkpoint` loses the last checkpoint if it is killed between its two
renames, see docs/upstream.md.

The metadata also hold a CRC-32 of each part (a key of the outermost dict), so that an agent can be
checked without reading a replay memory of gigabytes. A CRC-32 detects every change of up to 32
consecutive bits, and of other changes all but one in 2³². Cryptographic digests take 3 to 5 times
as long. They would not protect from an attacker, who would write the digest, too.
"""

from __future__ import annotations

import errno
import json
import os
import re
import zlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from flowrep.files import naming, replace_file

FORMAT = "flowrep checkpoint 7"


class CheckpointError(Exception):
    """A checkpoint could not be written or read; the message names it and the remedy."""


def save_checkpoint(path: str | os.PathLike[str], state: Mapping[str, Any]) -> None:
    """Writes `state` to `path` atomically: an interruption leaves no incomplete file there.

    Args:
        path: its folder is created if it does not exist.
        state: dicts with string keys, lists, tensors, str, int, float, bool and None, nested to
            any depth. Tuples come back as lists.

    Raises:
        TypeError: `state` holds anything else; the message names the key.
        CheckpointError: it can't be written (disk full, read-only). A previous file is kept.
    """
    path = Path(path)
    tensors: dict[str, Tensor] = {}
    document = _as_json(state, "", tensors)
    digests = {name: _restored(x, tensors.__getitem__)[1] for name, x in document["dict"].items()}
    metadata = {"format": FORMAT, "state": json.dumps(document), "crc32": json.dumps(digests)}
    try:
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(path) as partial:
            _write(tensors, metadata, partial)
    except OSError as error:
        kept = "; the previous checkpoint is untouched" if path.exists() else ""
        raise CheckpointError(f"cannot write the checkpoint: {error}{kept}") from error


def _write(tensors: dict[str, Tensor], metadata: dict[str, str], path: Path) -> None:
    try:
        save_file(tensors, path, metadata=metadata)
    except SafetensorError as error:  # an error of the disk; the errno is only in its text
        code = re.search(r"(?:os error |code: )(\d+)", str(error))
        number = int(code[1]) if code else errno.EIO
        raise OSError(number, os.strerror(number)) from error


def load_checkpoint(
    path: str | os.PathLike[str], parts: Collection[str] | None = None
) -> dict[str, Any]:
    """Returns the state that `save_checkpoint` wrote, tensors on the CPU.

    With `parts`, only these keys of the outermost dict are read.

    Raises:
        CheckpointError: the file is missing, damaged or not a checkpoint of this version.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: name a run folder that has saved one")
    try:
        # safetensors opens the name twice. /dev/fd/N stays the same file, even if a running
        # training replaces the checkpoint in between.
        with (
            path.open("rb") as opened,
            safe_open(f"/dev/fd/{opened.fileno()}", framework="pt") as file,
        ):
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(
                    f"{path} is a safetensors file but not a flowrep checkpoint of this version "
                    f"({FORMAT!r}); start a new run"
                )
            items, digests = json.loads(metadata["state"])["dict"], json.loads(metadata["crc32"])
            if parts is None and {*digests} != {*items}:
                raise ValueError("its parts are not those that were saved")
            state = {}
            for name in items if parts is None else parts:
                state[name], digest = _restored(items[name], file.get_tensor)
                if digest != digests[name]:
                    raise ValueError(f"{name!r} is not what was saved")
            return state
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(
            f"{path} is not a readable checkpoint ({error}): it is damaged or of another kind; "
            "restore a copy of it, or start a new run"
        ) from error


def _as_json(value: Any, at: str, tensors: dict[str, Tensor]) -> Any:
    """Returns `value` as JSON data and adds its tensors to `tensors`, under unique names.

    `at` is where the value is in the state, such as `/agent/weights`.
    """
    if isinstance(value, Tensor):
        tensor = value.detach().cpu().contiguous()
        memory = tensor.untyped_storage().data_ptr()
        if any(memory == other.untyped_storage().data_ptr() for other in tensors.values()):
            tensor = tensor.clone()  # the format allows no shared memory
        name = f"{at} {len(tensors)}"
        tensors[name] = tensor
        return {"tensor": name}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {k: _as_json(v, f"{at}/{k}", tensors) for k, v in value.items()}}
    if isinstance(value, list | tuple):
        return [_as_json(v, f"{at}/{i}", tensors) for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(
        f"checkpoint[{at!r}] is a {type(value).__name__}: expected a tensor, dict with strings as "
        "keys, list, str, int, float, bool or None"
    )


def _restored(part: Any, get_tensor: Callable[[str], Tensor]) -> tuple[Any, int]:
    """Returns the state of a part, and the CRC-32 of its JSON data and tensors."""
    tensors: list[Tensor] = []

    def get(name: str) -> Tensor:
        tensors.append(get_tensor(name))
        return tensors[-1]

    value = _from_json(part, get)
    kinds = [(str(tensor.dtype), list(tensor.shape)) for tensor in tensors]
    digest = zlib.crc32(json.dumps([part, kinds]).encode())
    for tensor in tensors:
        digest = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, digest)
    return value, digest


def _from_json(value: Any, get_tensor: Callable[[str], Tensor]) -> Any:
    """Inverts `_as_json`."""
    if isinstance(value, list):
        return [_from_json(item, get_tensor) for item in value]
    if not isinstance(value, dict):
        return value
    if "tensor" in value:
        return get_tensor(value["tensor"])
    return {key: _from_json(item, get_tensor) for key, item in value["dict"].items()}
