"""Saves and loads checkpoints: tensors and plain data in one file, written atomically.

The file is a safetensors file. The metadata in its header hold a JSON document that mirrors the
nested state, with each tensor as `{"tensor": name, "crc32": checksum}`, and the checksum of that
document. Every read, even of a part, verifies all checksums, so any changed byte is noticed.
Nothing in the file can run code. `torchrl.checkpoint` loses the last checkpoint if it is killed
between its two renames, see docs/upstream.md.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

FORMAT = "flowrep checkpoint 5"


class CheckpointError(Exception):
    """A checkpoint could not be written or read; the message names it and the remedy."""


def save_checkpoint(path: str | os.PathLike[str], state: Mapping[str, Any]) -> None:
    """Writes `state` to `path` atomically: an interruption leaves no incomplete file there.

    Args:
        path: its folder is created if it does not exist.
        state: dicts with string keys, lists, tensors, str, int, float, bool and None, nested to
            any depth. Tuples come back as lists.

    Raises:
        TypeError: if `state` holds anything else; the message names the place.
        CheckpointError: if the file cannot be written (disk full, read-only). A previous file is
            left untouched.
    """
    path = Path(path)
    tensors: dict[str, Tensor] = {}
    document = json.dumps(_without_tensors(state, "", tensors))
    # safetensors makes temporary files of its own; in a separate folder, those that a killed
    # writer leaves behind are easy to remove
    partial = path.with_name(f".{path.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        file = partial / path.name
        checksum = str(zlib.crc32(document.encode()))
        metadata = {"format": FORMAT, "state": document, "state_crc32": checksum}
        save_file(_unshared(tensors), file, metadata=metadata)
        file.chmod(partial.stat().st_mode & 0o666)  # like any new file, not owner-only
        _flush(file)
        _rename(file, path)
        _flush(path.parent)
    except (OSError, SafetensorError) as error:
        kept = "; the previous checkpoint is untouched" if path.exists() else ""
        raise CheckpointError(
            f"cannot write the checkpoint {path}: {error}{kept}. Free some space or make the "
            "folder writable"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def load_checkpoint(
    path: str | os.PathLike[str], parts: Collection[str] | None = None
) -> dict[str, Any]:
    """Returns the state that `save_checkpoint` wrote, tensors on the CPU.

    Args:
        path: the file.
        parts: the keys of the outermost dict to return; None for all.

    Raises:
        CheckpointError: if the file is missing, damaged or not a checkpoint of this version.
    """
    path = Path(path)
    while True:
        before = _version(path)
        try:
            return _read(path, parts)
        except CheckpointError:
            # safetensors opens the file twice: a run that saved in between is no damage
            if _version(path) == before:
                raise


def _version(path: Path) -> tuple[int, int] | None:
    """Returns what changes whenever the file is replaced; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _read(path: Path, parts: Collection[str] | None) -> dict[str, Any]:
    """Reads the file once, see `load_checkpoint`."""
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: name a run folder that has saved one")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(
                    f"{path} is a safetensors file but not a flowrep checkpoint of this version "
                    f"({FORMAT!r}); start a new run"
                )
            _check(zlib.crc32(metadata["state"].encode()), int(metadata["state_crc32"]), "document")
            document = json.loads(metadata["state"])
            if not isinstance(document, dict):
                raise TypeError(f"it holds a {type(document).__name__}, not a dict")
            # tensors are views of the file, so checking those not returned takes no memory
            state = {k: _with_tensors(v, file.get_tensor) for k, v in document["dict"].items()}
            return state if parts is None else {name: state[name] for name in parts}
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(
            f"{path} is not a readable checkpoint ({error}): it is damaged or of another kind; "
            "restore a copy of it, or start a new run"
        ) from error


def _rename(file: Path, path: Path) -> None:
    """Moves `file` to `path`, atomically replacing any file there."""
    os.replace(file, path)


def _flush(path: Path) -> None:
    """Waits until a file's contents, or a folder's entries, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _without_tensors(value: Any, place: str, tensors: dict[str, Tensor]) -> Any:
    """Returns `value` as JSON data and adds its tensors to `tensors`, named by their place."""
    if isinstance(value, Tensor):
        tensors[place] = value.detach().cpu().contiguous()
        return {"tensor": place, "crc32": _checksum(tensors[place])}
    if isinstance(value, Mapping):
        bad = [key for key in value if not isinstance(key, str)]
        if bad:
            raise TypeError(f"checkpoint[{place!r}] has the key {bad[0]!r}: only strings are kept")
        items = {k: _without_tensors(v, place + _segment(k), tensors) for k, v in value.items()}
        return {"dict": items}
    if isinstance(value, list | tuple):
        return [_without_tensors(v, place + _segment(str(i)), tensors) for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    raise TypeError(
        f"checkpoint[{place!r}] is a {type(value).__name__}: expected a tensor, dict, list, str, "
        "int, float, bool or None"
    )


def _unshared(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the tensors, copied where two share memory, which the format doesn't allow."""
    seen: set[int] = set()
    unshared = {}
    for name, tensor in tensors.items():
        memory = tensor.untyped_storage().data_ptr()
        unshared[name] = tensor.clone() if memory in seen else tensor
        seen.add(memory)
    return unshared


def _segment(key: str) -> str:
    """Returns a key as one step of a path, with the escapes of JSON pointers."""
    return "/" + key.replace("~", "~0").replace("/", "~1")


def _with_tensors(value: Any, get_tensor: Any) -> Any:
    """Undoes `_without_tensors`."""
    if isinstance(value, list):
        return [_with_tensors(item, get_tensor) for item in value]
    if isinstance(value, dict):
        if "tensor" in value:
            tensor = get_tensor(value["tensor"])
            _check(_checksum(tensor), value["crc32"], value["tensor"])
            return tensor
        ((kind, content),) = value.items()
        if kind == "dict":
            return {key: _with_tensors(item, get_tensor) for key, item in content.items()}
        return float(content)
    return value


def _checksum(tensor: Tensor) -> int:
    """Returns the CRC-32 of a contiguous tensor's type, shape and bytes."""
    kind = zlib.crc32(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
    data: Any = tensor.reshape(-1).view(torch.uint8).numpy()
    return zlib.crc32(data, kind)


def _check(found: int, expected: int, what: str) -> None:
    if found != expected:
        raise ValueError(f"{what} is not as it was written, its checksum differs")
