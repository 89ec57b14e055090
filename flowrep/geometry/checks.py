"""Shape and dtype checks of arguments; they are static, so compiled code doesn't run them."""

from __future__ import annotations

from typing import Any, get_args

import torch
from torch import Tensor


def check_shape(name: str, tensor: Tensor, trailing: tuple[int | str, ...]) -> None:
    """Checks that `tensor` holds floats and its last dims are `trailing`.

    Args:
        name: the argument's name, for the message.
        tensor: the argument.
        trailing: sizes of the last dims; a string is the name of a dim of any size.

    Raises:
        ValueError: if the number or a size of the trailing dims differs.
        TypeError: if it is not a float tensor.
    """
    check_is_tensor(name, tensor)
    if not tensor.is_floating_point():
        raise TypeError(
            f"{name} must be floating point (metres, pixels), got {tensor.dtype}; "
            "convert it first, e.g. millimetres with `depth.float() / 1000`"
        )
    check_trailing(name, tensor, trailing)


def check_is_tensor(name: str, tensor: object) -> None:
    """Raises TypeError if `tensor` is not a torch tensor."""
    if not isinstance(tensor, Tensor):
        raise TypeError(
            f"{name} must be a torch.Tensor, got {type(tensor).__name__}; "
            "wrap it with torch.as_tensor"
        )


def check_trailing(name: str, tensor: Tensor, trailing: tuple[int | str, ...]) -> None:
    """Raises ValueError if the last dims of `tensor` are not `trailing`."""
    wanted_dims = len(trailing)
    fits = tensor.ndim >= wanted_dims and all(
        isinstance(want, str) or got == want
        for got, want in zip(tensor.shape[tensor.ndim - wanted_dims :], trailing)
    )
    if not fits:
        wanted = ", ".join(["*B", *(str(size) for size in trailing)])
        raise ValueError(f"{name} must be [{wanted}], got {list(tensor.shape)}")


def broadcast_batch(**batches: torch.Size) -> torch.Size:
    """Returns the common leading batch of several arguments.

    Raises:
        ValueError: if they do not broadcast; lists the batch of each argument.
    """
    try:
        return torch.broadcast_shapes(*batches.values())
    except RuntimeError as error:
        listing = ", ".join(f"{name} {list(batch)}" for name, batch in batches.items())
        raise ValueError(
            f"leading batch dims do not broadcast: {listing}; give each the same batch, or none"
        ) from error


def check_name(option: str, name: object, names: Any) -> None:
    """Raises ValueError if `name` is not a value of the `Literal` `names`, and lists its values."""
    known = list(get_args(names))
    if name not in known:
        raise ValueError(f"{option} must be one of {known}, got {name!r}")


def check_rows(lowest: int, highest: int, rows: int) -> None:
    """Raises RuntimeError if ids from `lowest` to `highest` are no rows of `rows` motions."""
    if lowest < 0 or highest >= rows:
        raise RuntimeError(
            f"instance holds ids {lowest} to {highest}, but prev_from_curr_by_instance has {rows} "
            f"rows, for ids 0 to {rows - 1}; convert a simulator's ids, such as -1 for the "
            "background, with the transform InstanceIds or with flowrep.geometry.instance_rows"
        )
