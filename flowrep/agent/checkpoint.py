"""Saves and loads checkpoints: tensors and plain data in one file, written atomically.

The file is a safetensors file. The metadata in its header hold a JSON document that mirrors the
nested state, with each tensor as `{"tensor": name}` and each dict as `{"dict": items}`. Nothing in
it can run code. `torchrl.checkpoint` loses the last checkpoint if it is killed between its two
renames, see docs/upstream.md.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

FORMAT = "flowrep checkpoint 6"


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
        CheckpointError: if it can't be written (disk full, read-only). A previous file stays.
    """
    path = Path(path)
    tensors: dict[str, Tensor] = {}
    metadata = {"format": FORMAT, "state": json.dumps(_as_json(state, "", tensors))}
    # safetensors makes temporary files of its own; in a separate folder, those that a killed
    # writer leaves behind are easy to remove
    partial = path.with_name(f".{path.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        file = partial / path.name
        save_file(tensors, file, metadata=metadata)
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

    With `parts`, only these keys of the outermost dict are read.

    Raises:
        CheckpointError: if the file is missing, damaged or not a checkpoint of this version.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: name a run folder that has saved one")
    try:
        # safetensors opens the name twice; that of an open file stays the same file if a run that
        # goes on replaces the checkpoint in between
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
            items = json.loads(metadata["state"])["dict"]
            names = items if parts is None else parts
            return {name: _from_json(items[name], file.get_tensor) for name in names}
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{path} is not a readable checkpoint ({error}): it is damaged or of another kind; "
            "restore a copy of it, or start a new run"
        ) from error


def _rename(file: Path, path: Path) -> None:
    os.replace(file, path)


def _flush(path: Path) -> None:
    """Waits until a file's contents, or a folder's entries, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _as_json(value: Any, place: str, tensors: dict[str, Tensor]) -> Any:
    """Returns `value` as JSON data and adds its tensors to `tensors`, named by place and number."""
    if isinstance(value, Tensor):
        tensor = value.detach().cpu().contiguous()
        memory = tensor.untyped_storage().data_ptr()
        if any(memory == other.untyped_storage().data_ptr() for other in tensors.values()):
            tensor = tensor.clone()  # the format allows no shared memory
        name = f"{place} {len(tensors)}"
        tensors[name] = tensor
        return {"tensor": name}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {k: _as_json(v, f"{place}/{k}", tensors) for k, v in value.items()}}
    if isinstance(value, list | tuple):
        return [_as_json(v, f"{place}/{i}", tensors) for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(
        f"checkpoint[{place!r}] is a {type(value).__name__}: expected a tensor, dict with strings "
        "as keys, list, str, int, float, bool or None"
    )


def _from_json(value: Any, get_tensor: Any) -> Any:
    """Undoes `_as_json`."""
    if isinstance(value, list):
        return [_from_json(item, get_tensor) for item in value]
    if not isinstance(value, dict):
        return value
    if "tensor" in value:
        return get_tensor(value["tensor"])
    return {key: _from_json(item, get_tensor) for key, item in value["dict"].items()}
