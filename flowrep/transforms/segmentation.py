"""Semantic classes as ids or as one map per class."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec

from flowrep.transforms.base import IDS, Keys, MapTransform

ENCODINGS = ("ids", "onehot")


class Segmentation(MapTransform):
    """Class of every pixel: the paper's semantic segmentation.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "semantic")` | `"seg"`, ids | uint8 `[*B, 1, H, W]` | 0 … n − 1 | class |
    | | `"seg"`, onehot | float32 `[*B, n, H, W]` | 0 or 1 | |

    In a replay buffer, ids take an eighth of the memory of a one-hot float map of two classes.
    Their spec is a `Categorical` with n, so a network can expand them. An id outside 0 … n − 1 is a
    pixel without a class, all zeros in the one-hot encoding.

    In each call, ids of a wider or signed type are checked before conversion to uint8, which waits
    for a GPU. Pass uint8 to avoid that.

    Args:
        num_classes: number n of classes, 1 to 256.
        encoding: `"ids"` or `"onehot"`.
        in_keys: key of the ids.
        out_keys: key of the representation.

    Raises:
        ValueError: for an unknown encoding or a number of classes that uint8 can't hold, and in
            each call for ids that it can't hold.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> sensor = {"semantic": torch.tensor([[[0, 2, 1]]], dtype=torch.uint8)}
        >>> td = TensorDict({"sensor": sensor})
        >>> Segmentation(num_classes=3, encoding="onehot")(td)["seg"][:, 0]
        tensor([[1., 0., 0.],
                [0., 0., 1.],
                [0., 1., 0.]])
    """

    def __init__(
        self,
        num_classes: int,
        *,
        encoding: str = "ids",
        in_keys: Keys = ("sensor", "semantic"),
        out_keys: Keys = "seg",
    ) -> None:
        super().__init__([IDS], in_keys, out_keys)
        if encoding not in ENCODINGS:
            raise ValueError(f"encoding must be one of {list(ENCODINGS)}, got {encoding!r}")
        if not 1 <= num_classes <= 256:
            raise ValueError(f"num_classes must be 1 to 256 (ids are uint8), got {num_classes}")
        self.num_classes = int(num_classes)
        self.encoding = encoding

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        ids = next_tensordict.get(self.in_keys[0], None)
        if self.encoding == "ids" and ids is not None:
            self._check_layout([ids], next_tensordict.batch_size)
            _check_fits_uint8(self.in_keys[0], ids)
        return super()._call(next_tensordict)

    def compute(self, ids: Tensor) -> tuple[Tensor]:
        """Returns the classes in the chosen encoding."""
        if self.encoding == "ids":
            return (ids.to(torch.uint8),)
        classes = torch.arange(self.num_classes, device=ids.device)[:, None, None]
        return ((ids == classes).float(),)  # [*B, n, H, W]

    def output_specs(self, ids: TensorSpec) -> tuple[TensorSpec]:
        """Returns a categorical spec for ids, a bounded one for one-hot maps."""
        if self.encoding == "ids":
            spec = Categorical(
                self.num_classes, shape=ids.shape, device=ids.device, dtype=torch.uint8
            )
            return (spec,)
        shape = (*ids.shape[:-3], self.num_classes, *ids.shape[-2:])
        return (Bounded(0.0, 1.0, shape=shape, device=ids.device, dtype=torch.float32),)


def _check_fits_uint8(key: object, ids: Tensor) -> None:
    """Raises ValueError for ids that wrap in uint8, where 300 would become 44."""
    if ids.dtype is torch.uint8 or not ids.numel():
        return
    least, most = (int(bound) for bound in ids.aminmax())
    if least < 0 or most > 255:
        raise ValueError(
            f"{key!r} holds class ids from {least} to {most}, but uint8 only ids "
            "from 0 to 255; give pixels without a class an id in that range, e.g. "
            "ids.where((ids >= 0) & (ids < num_classes), 255), or use encoding='onehot'"
        )
