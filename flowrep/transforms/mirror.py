"""Left-right images of transitions, for replay in worlds that are their own mirror image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.envs.transforms import Transform

from flowrep.geometry.checks import check_name
from flowrep.transforms.base import Keys, MissingKey, as_keys

Images = Literal["half", "all"]
_INTEGERS = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}  # by bytes


class Mirror(Transform):
    """Left-right images of the transitions that a replay buffer samples.

    In a street whose mirror image is as likely, what holds for a left turn holds for a right turn.
    In a transition's image, the columns of the maps are reversed, at the root and under `"next"`,
    the horizontal component of flows is negated, and the action is exchanged. Reward and done flags
    stay the same. `flowrep.envs.make_mirror` chooses all arguments for a street.

    | reads and writes | shape | its image |
    | --- | --- | --- |
    | a map | `[*B, C, H, W]` | column i is column 2·cx - 1 - i |
    | a flow (`flow_keys`) | `[*B, 2·k, H, W]`, u and v of k frames | the same, with u negated |
    | `"action"` | `[*B]` or one-hot `[*B, n]` | `swapped_actions[action]` |

    Convention: pixel (0, 0)'s centre is (0.5, 0.5), so that column i sees x / z = (i + 0.5 - cx) /
    fx, and column 2·cx - 1 - i sees the opposite. With cx = W / 2, the first column becomes the
    last. flowrep's simulated camera samples a pixel at its left edge, cx = W / 2 + 0.5: column i
    becomes W - i, and the image of column 0 would need column W, which doesn't exist. Such columns,
    |2·cx - W| of them at one border, take the nearest column that was seen; the others are exact.

    It keeps no state and overwrites what it reads. It is for replay buffers: in an env, actions
    would have to be exchanged before they are taken.

    Args:
        in_keys: all maps to mirror.
        flow_keys: those of `in_keys` that are flows.
        swapped_actions: for each action, its mirror image, such as `[0, 2, 1]` for (straight on,
            left, right).
        intrinsics: K `[3, 3]` of the maps, without skew; None if it is centred, cx = W / 2. 2·cx
            has to be whole, since class ids can't be interpolated.
        images: "half" replaces each transition with probability 1/2, a trajectory (with a dimension
            named "time") as a whole; "all" replaces all.

    Raises:
        ValueError: `in_keys` repeats a key, `flow_keys` holds a key that `in_keys` lacks,
            `swapped_actions` doesn't exchange actions in pairs, K has skew, or 2·cx isn't whole; in
            calls, a map's width differs from 2·cx by half or more.
        MissingKey: in calls, the batch lacks a map.
        RuntimeError: it is used in an env.

    Example:
        >>> from tensordict import TensorDict
        >>> flow = torch.tensor([[[1.0, 2.0, 3.0]], [[4.0, 5.0, 6.0]]])  # u and v of one row
        >>> td = TensorDict({"raw": flow, "action": torch.tensor(1)})
        >>> mirror = Mirror("raw", flow_keys="raw", swapped_actions=[0, 2, 1], images="all")
        >>> mirror(td)["raw"].tolist(), td["action"].item()
        ([[[-3.0, -2.0, -1.0]], [[6.0, 5.0, 4.0]]], 2)
    """

    invertible = False
    swapped_actions: Tensor

    def __init__(
        self,
        in_keys: Keys,
        *,
        swapped_actions: Sequence[int],
        flow_keys: Keys | None = None,
        intrinsics: Tensor | Sequence[Sequence[float]] | None = None,
        images: Images = "half",
    ) -> None:
        keys = as_keys(in_keys)
        if len({*keys}) < len(keys):  # mirrored twice, a map would be the original
            raise ValueError(f"in_keys names a map twice: {keys}")
        super().__init__(in_keys=keys, out_keys=keys)
        self.flow_keys = [] if flow_keys is None else as_keys(flow_keys)
        unknown = [key for key in self.flow_keys if key not in keys]
        if unknown:
            raise ValueError(f"flow_keys has {unknown}, which in_keys lacks: {keys}")
        swapped = torch.as_tensor(swapped_actions, dtype=torch.long)
        actions = torch.arange(len(swapped))
        if sorted(swapped.tolist()) != actions.tolist() or not swapped[swapped].equal(actions):
            raise ValueError(
                "swapped_actions must exchange actions in pairs, or map one to itself; got "
                f"{swapped.tolist()}"
            )
        check_name("images", images, Images)
        self.register_buffer("swapped_actions", swapped, persistent=False)
        self.twice_cx = None if intrinsics is None else _twice_cx(intrinsics)
        self.images = images

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the batch with images instead of transitions."""
        if lacking := [key for key in self.in_keys if tensordict.get(key, None) is None]:
            known = sorted(tensordict.keys(True, True), key=str)
            raise MissingKey(f"Mirror needs key {lacking[0]!r}; the batch has {known}")
        shape, device = tensordict.batch_size, tensordict["action"].device
        if self.images == "half":
            drawn = [1 if name == "time" else n for name, n in zip(tensordict.names, shape)]
            chosen = (torch.rand(drawn, device=device) < 0.5).expand(shape)
            return self._mirror(tensordict, chosen)
        return self._mirror(tensordict, torch.ones(shape, dtype=torch.bool, device=device))

    def images_of(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Returns the mirror images of maps `[*B, C, H, W]`, one for each of `in_keys`."""
        everywhere = torch.ones((), dtype=torch.bool, device=maps[0].device)
        for key, x in zip(self.in_keys, maps):
            self._check_width(key, x.shape[-1])
        return [
            mirror_map(x, everywhere, self.twice_cx, is_flow=key in self.flow_keys)
            for key, x in zip(self.in_keys, maps)
        ]

    def _mirror(self, tensordict: TensorDictBase, chosen: Tensor) -> TensorDictBase:
        """Replaces the `chosen` `[*B]` transitions by their images."""
        action, swapped = tensordict["action"], self.swapped_actions.to(chosen.device)
        is_one_hot = action.ndim > chosen.ndim and action.shape[-1] == len(swapped)
        if action.is_floating_point() and not is_one_hot:
            raise TypeError(f"Mirror exchanges discrete actions, got {action.dtype}")
        image = action[..., swapped] if is_one_hot else swapped[action.long()].to(action.dtype)
        tensordict["action"] = torch.where(expand_as_right(chosen, action), image, action)
        following = tensordict.get("next", None)
        for step in (tensordict, following):
            mask = None if step is None else step.get("action_mask", None)
            if mask is not None:
                step["action_mask"] = torch.where(
                    expand_as_right(chosen, mask), mask[..., swapped], mask
                )
        for key in self.in_keys:
            is_flow = key in self.flow_keys
            for step in (tensordict, following):
                x = None if step is None else step.get(key, None)
                if x is not None:
                    self._check_width(key, x.shape[-1])
                    step[key] = mirror_map(x, chosen, self.twice_cx, is_flow=is_flow)
        return tensordict

    def _check_width(self, key: NestedKey, width: int) -> None:
        # Pictures for estimated flow may be several times as large as the camera's maps.
        if self.twice_cx is not None and not width / 1.5 < self.twice_cx < width * 1.5:
            raise ValueError(
                f"{key!r} is {width} pixels wide, but 2·cx is {self.twice_cx}: it is not of the "
                "camera of these intrinsics; leave it out or train without mirror images "
                "(algorithm.mirror=false)"
            )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError("Mirror is for replay: append it to a replay buffer, not to an env")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.in_keys}, images={self.images!r})"


def mirror_map(x: Tensor, chosen: Tensor, twice_cx: int | None, *, is_flow: bool) -> Tensor:
    """Returns maps `[*B, C, H, W]`, the `chosen` `[*B]` of them mirrored; see `Mirror`."""
    # As integers, because PyTorch reverses floats of two bytes five times as slowly.
    bits = x.view(_INTEGERS[x.element_size()])
    image = bits.flip(-1)
    shift = 0 if twice_cx is None else twice_cx - x.shape[-1]
    if shift:  # columns beyond the border take the nearest one
        border = image[..., :1] if shift > 0 else image[..., -1:]
        border = border.expand(*image.shape[:-1], abs(shift))
        parts = [border, image[..., :-shift]] if shift > 0 else [image[..., -shift:], border]
        image = torch.cat(parts, -1)
    if is_flow:
        image.view(x.dtype)[..., ::2, :, :].neg_()  # u
    # The image's bits where `chosen`, else those of x, in half the time of `torch.where`.
    mask = -chosen.to(bits.dtype)[..., None, None, None]
    return image.bitwise_xor_(bits).bitwise_and_(mask).bitwise_xor_(bits).view(x.dtype)


def _twice_cx(intrinsics: Any) -> int:
    K = torch.as_tensor(intrinsics, dtype=torch.float64)
    if K.shape != (3, 3) or K[0, 1] != 0:
        raise ValueError(f"intrinsics should be one [3, 3] without skew, got {K.tolist()}")
    twice_cx = round(2 * K[0, 2].item())
    if abs(2 * K[0, 2].item() - twice_cx) > 1e-3:
        raise ValueError(
            f"the camera's cx is {K[0, 2].item():g}, so columns would have to be interpolated; "
            "Mirror needs a whole 2·cx"
        )
    return twice_cx
