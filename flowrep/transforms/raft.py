"""Optical flow by RAFT, torchvision's network, with weights from a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowrep.transforms.dis import whole_factor

SMALLEST_SIDE_PX = 128  # the network's coarsest correlation level has 1 / 64 of this
_MULTIPLE_PX = 8  # the network works at an eighth of the size
NETWORKS = ("raft_small", "raft_large")


class RAFT(nn.Module):
    """Recurrent all-pairs field transforms: flow by a network, on any device.

    Small pictures are enlarged by a whole factor and the flow is scaled back to their pixels.
    Sides that are not a multiple of 8 are padded by repeating the border, and the padding is
    cropped again. On pairs with hardly any motion it is noisier than DIS.

    Args:
        weights: a file with the network's state dict, `.safetensors` or `.pth`, read without
            unpickling objects. The weights published by torchvision fit.
        network: `"raft_small"` or `"raft_large"`, matching the weights.
        updates: number of refinements of the flow; more are slower and more accurate.
        min_side_px: pictures with a shorter side below this are enlarged to at least this; not
            below 128.

    Raises:
        ImportError: torchvision is missing or was built for another torch.
        FileNotFoundError: there is no file at that path.
        ValueError: for an unknown network, a size that is too small, or weights that do not fit.
    """

    def __init__(
        self,
        weights: str | Path,
        network: str = "raft_small",
        updates: int = 12,
        min_side_px: int = SMALLEST_SIDE_PX,
    ) -> None:
        super().__init__()
        if network not in NETWORKS:
            raise ValueError(f"network must be one of {list(NETWORKS)}, got {network!r}")
        if min_side_px < SMALLEST_SIDE_PX or updates < 1:
            raise ValueError(
                f"RAFT needs min_side_px of at least {SMALLEST_SIDE_PX} and at least one update, "
                f"got {min_side_px} and {updates}"
            )
        self.updates, self.min_side_px = int(updates), int(min_side_px)
        state = _read_weights(Path(weights))
        self.network = getattr(_optical_flow(), network)(weights=None)
        try:
            self.network.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(
                f"{weights} does not hold the weights of {network}: {str(error)[:200]}"
            ) from error
        self.network.eval().requires_grad_(False)

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Returns the displacement of each pixel from the first picture to the second.

        Convention: `[N, 2, H, W]` float32, (u right, v down), pixels, on the first picture's grid.

        Args:
            first: uint8 `[N, 3, H, W]`, RGB.
            second: as `first`.
        """
        height, width = first.shape[-2:]
        factor = whole_factor(height, width, self.min_side_px)
        first, second = (self._prepared(picture, factor) for picture in (first, second))
        flow = self.network(first, second, num_flow_updates=self.updates)[-1]
        flow = flow[..., : height * factor, : width * factor]
        return functional.avg_pool2d(flow, factor) / factor if factor > 1 else flow

    def train(self, mode: bool = True) -> RAFT:
        """Keeps the network in evaluation mode, even if its env is put into training mode."""
        return super().train(False)

    @staticmethod
    def _prepared(pictures: Tensor, factor: int) -> Tensor:
        """Returns pictures in [-1, 1], enlarged, with sides that are multiples of 8."""
        scaled = pictures.float() / 127.5 - 1.0
        if factor > 1:
            scaled = functional.interpolate(
                scaled, scale_factor=factor, mode="bilinear", align_corners=False
            )
        bottom, right = (-side % _MULTIPLE_PX for side in scaled.shape[-2:])
        return functional.pad(scaled, (0, right, 0, bottom), mode="replicate")


def _read_weights(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise FileNotFoundError(
            f"no RAFT weights at '{path}': give weights= the state dict of a torchvision RAFT, "
            "a .safetensors or .pth file; none come with flowrep"
        )
    if path.suffix == ".safetensors":
        try:
            from safetensors.torch import load_file
        except ImportError as error:
            raise ImportError(f"'{path}' needs safetensors: pip install safetensors") from error
        return _state_of(path, lambda: load_file(path))
    return _state_of(path, lambda: torch.load(path, map_location="cpu", weights_only=True))


def _state_of(path: Path, read: Callable[[], Any]) -> dict[str, Tensor]:
    """Returns a reader's state dict; hides its error message, which advises trusting the file."""
    try:
        state = read()
    except Exception as error:  # readers fail on garbage in as many ways as there is garbage
        if isinstance(error, OSError):
            raise
        raise ValueError(
            f"'{path}' is not a readable weights file ({type(error).__name__}): it is damaged, or "
            "holds more than a state dict. Save the network's state_dict() again, preferably as "
            ".safetensors"
        ) from None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"'{path}' holds no state dict, a mapping from names to tensors")
    return state


def _optical_flow() -> Any:
    try:
        from torchvision.models import optical_flow
    except (ImportError, RuntimeError) as error:  # RuntimeError: built for another torch
        raise ImportError(
            "flow estimated by RAFT needs the torchvision that belongs to your torch: "
            f"pip install 'flowrep[raft]' ({error})"
        ) from error
    return optical_flow
