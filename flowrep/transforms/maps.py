"""Transforms of a single map: picture, segmentation, depth, and instance ids."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec

from flowrep import geometry
from flowrep.geometry.checks import check_name, checked_count, checked_number
from flowrep.transforms.base import (
    DEPTH,
    IDS,
    RGB,
    Keys,
    MapTransform,
    check_distinct_keys,
    has_values,
    signed_type,
)

Encoding = Literal["ids", "onehot"]

_CALLS_PER_LOOK = 100  # on a GPU, one call of this many checks ids: each check waits for them
_LINK_BIT = 24  # PyBullet's ids: body + (link + 1 << 24)


class Rgb(MapTransform):
    """The camera's colour picture, unchanged.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "rgb")` | `"rgb"` | uint8 `[*B, 3, H, W]` | 0 … 255 | |

    It stays uint8, which takes a quarter of the memory of float32 in a replay buffer. The spec's
    bounds tell a network what to divide by.

    Example:
        >>> from tensordict import TensorDict
        >>> picture = torch.full((3, 2, 4), 7, dtype=torch.uint8)
        >>> Rgb()(TensorDict({"sensor": {"rgb": picture}}))["rgb"].shape
        torch.Size([3, 2, 4])
    """

    def __init__(self, *, in_keys: Keys = ("sensor", "rgb"), out_keys: Keys = "rgb") -> None:
        super().__init__([RGB], in_keys, out_keys)

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        (rgb,) = super()._tensors(tensordict)
        _check_bytes(rgb, f"{self.in_keys[0]!r} holds values", "divide pictures of 16 bits by 257")
        return [rgb]

    def compute(self, rgb: Tensor) -> tuple[Tensor]:
        """Returns the picture in uint8."""
        return (rgb.to(torch.uint8),)

    def output_specs(self, rgb: TensorSpec) -> tuple[TensorSpec]:
        """Returns a spec bounded to 0 … 255."""
        return (Bounded(0, 255, shape=rgb.shape, device=rgb.device, dtype=torch.uint8),)


class Segmentation(MapTransform):
    """The class of every pixel: the paper's semantic segmentation.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "semantic")` | `"seg"`, ids | uint8 `[*B, 1, H, W]` | 0 … n − 1 | class |
    | | `"seg"`, onehot | float32 `[*B, n, H, W]` | 0 or 1 | |

    In a replay buffer, ids take an eighth of the memory of a one-hot float map of two classes.
    Their spec is a `Categorical` with n, so that a network can expand them. An id outside 0 … n − 1
    marks a pixel without a class, whose one-hot encoding is all zeros.

    Ids of a wider or signed type are checked in each call before they are converted to uint8. The
    check waits for a GPU; pass uint8 to avoid it.

    Args:
        num_classes: n, 1 to 256.
        encoding: `"ids"` or `"onehot"`.

    Raises:
        ValueError: in calls, with `encoding="ids"`, for ids outside 0 … 255.

    Example:
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
        encoding: Encoding = "ids",
        in_keys: Keys = ("sensor", "semantic"),
        out_keys: Keys = "seg",
    ) -> None:
        super().__init__([IDS], in_keys, out_keys)
        check_name("encoding", encoding, Encoding)
        self.num_classes = checked_count("num_classes", num_classes, most=256)  # ids are uint8
        self.encoding = encoding

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        (ids,) = super()._tensors(tensordict)
        if self.encoding == "ids":
            remedy = (
                "give pixels without a class an id in that range, e.g. "
                "ids.where((ids >= 0) & (ids < num_classes), 255), or use encoding='onehot'"
            )
            _check_bytes(ids, f"{self.in_keys[0]!r} holds class ids", remedy)
        return [ids]

    def compute(self, ids: Tensor) -> tuple[Tensor]:
        """Returns the classes in the chosen encoding."""
        if self.encoding == "ids":
            return (ids.to(torch.uint8),)
        classes = torch.arange(self.num_classes, device=ids.device)[:, None, None]
        return ((ids == classes).float(),)  # [*B, n, H, W]

    def output_specs(self, ids: TensorSpec) -> tuple[TensorSpec]:
        """Returns a categorical spec for ids, a bounded one for one-hot maps."""
        if self.encoding == "ids":
            n, dtype = self.num_classes, torch.uint8
            return (Categorical(n, shape=ids.shape, device=ids.device, dtype=dtype),)
        shape = (*ids.shape[:-3], self.num_classes, *ids.shape[-2:])
        return (Bounded(0.0, 1.0, shape=shape, device=ids.device, dtype=torch.float32),)


class Depth(MapTransform):
    """Depth along the optical axis, divided by `range_m` and clipped to [0, 1].

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"depth"` | float32 `[*B, 1, H, W]` | 0 … 1 | `range_m` |

    Sky (`inf`) and everything beyond `range_m` become 1, holes (`nan`) become `missing`.

    Args:
        range_m: the depth that becomes 1, metres.
        missing: the value of a hole, 0 to 1.

    Raises:
        ValueError: `range_m` isn't positive and finite, or `missing` isn't in [0, 1].

    Example:
        >>> from tensordict import TensorDict
        >>> depth = torch.tensor([[[25.0, 400.0, torch.inf, torch.nan]]])
        >>> Depth(range_m=100.0)(TensorDict({"sensor": {"depth": depth}}))["depth"]
        tensor([[[0.2500, 1.0000, 1.0000, 0.0000]]])
    """

    def __init__(
        self,
        *,
        range_m: float = 100.0,
        missing: float = 0.0,
        in_keys: Keys = ("sensor", "depth"),
        out_keys: Keys = "depth",
    ) -> None:
        super().__init__([DEPTH], in_keys, out_keys)
        metres = "a positive number of metres"
        self.range_m = checked_number("range_m", range_m, metres, lambda x: x > 0)
        share = "in [0, 1], the value for nan"
        self.missing = checked_number("missing", missing, share, lambda x: 0 <= x <= 1)

    def compute(self, depth: Tensor) -> tuple[Tensor]:
        """Returns depth / range_m in [0, 1]."""
        near = (depth / self.range_m).clamp(0.0, 1.0)  # inf becomes 1, nan stays
        return (torch.where(near.isnan(), self.missing, near).float(),)

    def output_specs(self, depth: TensorSpec) -> tuple[TensorSpec]:
        """Returns a spec bounded to [0, 1]."""
        return (Bounded(0.0, 1.0, shape=depth.shape, device=depth.device, dtype=torch.float32),)


class InstanceIds(MapTransform):
    """Converts a simulator's instance ids to rows of `instance_motion`.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | ids | `("sensor", "instance")` | uint8 `[*B, 1, H, W]` (int32 from 256 bodies) | 0 … N | row |

    Ids without a row become 0, the static world. A warning names each of them once, with its share
    of the pixels, unless it is negative (a background) or one of `static_ids`. Every call searches
    for such ids until the first warning; after it, and always on a GPU, one call in a hundred does.

    PyBullet's ids with links (`ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX`) hold the body's id in
    the low 24 bits and 1 + the link's index above them. For these, `body_ids` lists (body, link)
    pairs, in the order of the links' poses; the base is link -1.

    Args:
        body_ids: the ids of the bodies, or (body, link) pairs, in the order of their poses: the
            first becomes 1.
        static_ids: ids of what stands still, such as the floor.
        links_as_body: whether PyBullet's links that `body_ids` lacks get their body's row.
        out_keys: must differ from `in_keys`, so that nothing is converted twice.

    Raises:
        ValueError: `body_ids` lists a body twice; or, in calls, the ids are PyBullet's with links,
            `body_ids` lists bodies without links, and `links_as_body` is False.

    Example:
        >>> from tensordict import TensorDict
        >>> rows = InstanceIds([17, 3], in_keys="segmentation")
        >>> td = rows(TensorDict(segmentation=torch.tensor([[[0, 3, 17, -1]]])))
        >>> td["sensor", "instance"]
        tensor([[[0, 2, 1, 0]]], dtype=torch.uint8)
    """

    body_ids: Tensor

    def __init__(
        self,
        body_ids: Sequence[int | tuple[int, int]],
        *,
        static_ids: Sequence[int] = (0,),
        links_as_body: bool = False,
        in_keys: Keys = "segmentation",
        out_keys: Keys = ("sensor", "instance"),
    ) -> None:
        super().__init__([IDS], in_keys, out_keys)
        check_distinct_keys(self)
        packed = [_packed(*x) if isinstance(x, (tuple, list)) else int(x) for x in body_ids]
        if len(set(packed)) != len(packed):
            raise ValueError(f"body_ids must list each body once, got {list(body_ids)}")
        ids = torch.tensor(packed, dtype=torch.long)
        self.register_buffer("body_ids", ids, persistent=False)
        self.links_as_body = bool(links_as_body)
        self._static = {int(each) for each in static_ids}
        self._calls_to_skip = 0

    def compute(self, ids: Tensor) -> tuple[Tensor]:
        """Returns each pixel's row."""
        rows = geometry.instance_rows(ids, self.body_ids)
        if self.links_as_body:
            bodies = geometry.instance_rows(_body_of(ids), self.body_ids)
            rows = torch.where(rows == 0, bodies, rows)
        return (rows,)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = super()._call(next_tensordict)
        ids = next_tensordict.get(self.in_keys[0], None)
        if ids is None or not has_values(ids):
            return next_tensordict
        self._calls_to_skip -= 1
        if self._calls_to_skip < 0:
            self._calls_to_skip = _CALLS_PER_LOOK - 1 if ids.is_cuda else 0
            ids = ids.to(signed_type(ids.dtype))
            self._name_ids_without_row(ids, next_tensordict[self.out_keys[0]])
        return next_tensordict

    def _name_ids_without_row(self, ids: Tensor, rows: Tensor) -> None:
        """Warns of ids that count as the static world; ValueError if they are bodies' links."""
        without = (rows == 0) & (ids >= 0)
        for number in self._static:
            without &= ids != number
        if not bool(without.any()):
            return
        numbers, counts = (x.tolist() for x in ids[without].unique(return_counts=True))
        bodies = self.body_ids.tolist()
        if not self.links_as_body and max(bodies, default=0) < 1 << _LINK_BIT:
            links = [n for n in numbers if n >> _LINK_BIT and n % (1 << _LINK_BIT) in bodies]
            if links:
                raise ValueError(
                    f"{self.in_keys[0]!r} holds PyBullet's ids with links, for instance "
                    f"{_id_text(links[0])}, but body_ids lists bodies without links: list (body, "
                    "link) for each link with a pose, -1 for the base, or set links_as_body=True"
                )
        shares = [f"{_id_text(n)} ({count / ids.numel():.1%})" for n, count in zip(numbers, counts)]
        warnings.warn(
            f"{self.in_keys[0]!r}: ids without a row count as the static world: "
            f"{', '.join(shares[:8])} of the pixels{', ...' * (len(shares) > 8)}. If they move, "
            "add them to body_ids; if not, to static_ids",
            stacklevel=2,
        )
        self._static |= set(numbers)
        self._calls_to_skip = _CALLS_PER_LOOK - 1  # the search is another pass over the ids

    def output_specs(self, ids: TensorSpec) -> tuple[TensorSpec]:
        """Returns a categorical spec of 1 + N rows."""
        rows = 1 + len(self.body_ids)
        dtype = torch.uint8 if rows <= 256 else torch.int32
        return (Categorical(rows, shape=ids.shape, device=ids.device, dtype=dtype),)


def _check_bytes(values: Tensor, what: str, remedy: str) -> None:
    """Raises ValueError for whole numbers that would wrap in uint8, as 300 would become 44."""
    if values.dtype is torch.uint8 or not values.numel():
        return
    if not has_values(values):  # compiled code can't branch on them
        torch._assert_async(((values >= 0) & (values <= 255)).all(), f"{what} beyond 0 to 255")
        return
    least, most = (int(bound) for bound in values.aminmax())
    if least < 0 or most > 255:
        raise ValueError(
            f"{what} from {least} to {most}, but uint8 can hold only 0 to 255; {remedy}"
        )


def _packed(body: int, link: int) -> int:
    """Returns PyBullet's id of a body's link."""
    return body + (link + 1 << _LINK_BIT)


def _body_of(ids: Tensor) -> Tensor:
    """Returns the bodies' ids, from PyBullet's ids with links; negative ids are kept."""
    # Integers of one or two bytes can't hold links.
    return torch.where(ids < 0, ids, ids % (1 << _LINK_BIT)) if ids.element_size() > 2 else ids


def _id_text(number: int) -> str:
    link, body = divmod(number, 1 << _LINK_BIT)
    return f"{number} = body {body}, link {link - 1}" if link else str(number)
