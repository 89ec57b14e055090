"""Optical flow estimated from two pictures, for envs that have no exact flow."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional
from torchrl.data import TensorSpec, Unbounded

from flowrep import geometry
from flowrep.extras import require
from flowrep.geometry.checks import check_name, checked_count
from flowrep.transforms import base
from flowrep.transforms.base import Keys, Reads
from flowrep.transforms.flow import EGO_KEYS, FlowTransform, Intrinsics

PICTURE_PAIR = Reads((6, "kH", "kW"), "integer")

# An estimate of an object's flow counts where it reduces the pictures' squared difference to less
# than 0.9 of what ego flow leaves, and by more than rounding to grey levels could. With 0.7, false
# object flow above 0.3 px was 8 % rarer, but people 8 to 20 m ahead lost another 4 percentage
# points of their flow.
_MISFIT_SHARE, _ROUNDING_GREY_LEVELS = 0.9, 2.0

# Takes two uint8 [N, 3, H, W], returns the flow from the first to the second, float [N, 2, H, W].
Estimator = Callable[[Tensor, Tensor], Tensor]

Preset = Literal["ultrafast", "fast", "medium", "fine"]  # the first three are OpenCV's 0 to 2
Network = Literal["raft_small", "raft_large"]
SMALLEST_SIDE_PX = 128  # the network's coarsest correlation level, 1/64 of it, then has 2 px
_MULTIPLE_PX = 8  # the network works at an eighth of the size


@dataclass(frozen=True)
class DIS:
    """Dense inverse search (Kroeger et al., 2016) by OpenCV: a few milliseconds a picture on a CPU.

    Small pictures are enlarged by a whole factor and the flow is scaled back to their pixels: the
    preset "medium" matches patches of 8 px at half size, which is too coarse for a picture of 48
    px. The faster presets choose their scale by the picture's width, and gain little or nothing
    from this. "fine" is "medium" at the picture's full size with a tenth of the smoothing. People
    keep more of their flow, at twice the cost.

    A batch is split among as many threads as torch uses (`torch.set_num_threads`), as OpenCV
    releases Python's lock. Pictures on another device are copied to the CPU and their flow back,
    which waits for the device.

    Args:
        preset: OpenCV's `"ultrafast"`, `"fast"` or `"medium"`, or `"fine"`.
        min_side_px: pictures whose shorter side is below this are enlarged to at least this; 1
            enlarges none.

    Example:
        >>> ramp = torch.linspace(0, 255, 40).to(torch.uint8).expand(1, 3, 40, 40)
        >>> DIS()(ramp, ramp).abs().max()  # nothing moved
        tensor(0.)
    """

    preset: str = "medium"
    min_side_px: int = 160

    def __post_init__(self) -> None:
        check_name("preset", self.preset, Preset)
        checked_count("min_side_px", self.min_side_px)
        _opencv()

    def __call__(self, first: Tensor, second: Tensor) -> Tensor:
        """Returns the displacement of each pixel from the first picture to the second.

        Convention: `[N, 2, H, W]` float32, (u right, v down), pixels, on the first picture's grid;
        pictures are RGB, uint8 `[N, 3, H, W]`.
        """
        arrays = (x.movedim(-3, -1).contiguous().cpu().numpy() for x in (first, second))
        pairs = list(zip(*arrays))
        with ThreadPoolExecutor(max(1, min(len(pairs), torch.get_num_threads()))) as pool:
            flows = list(pool.map(lambda pair: self._flow(*pair), pairs))
        if not flows:
            return torch.zeros(0, 2, *first.shape[-2:], device=first.device)
        return torch.stack(flows).to(first.device)

    def _flow(self, first: Any, second: Any) -> Tensor:
        cv2 = _opencv()
        height, width = first.shape[:2]
        factor = whole_factor(height, width, self.min_side_px)
        grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second)]
        if factor > 1:
            size = (width * factor, height * factor)
            grey = [cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC) for picture in grey]
        # A new estimator in each call: its buffers aren't thread-safe, and creating it is cheap.
        is_fine = self.preset == "fine"
        number = get_args(Preset).index("medium" if is_fine else self.preset)
        estimator = cv2.DISOpticalFlow_create(number)
        if is_fine:
            estimator.setFinestScale(0)
            estimator.setPatchStride(4)
            estimator.setGradientDescentIterations(12)
            estimator.setVariationalRefinementAlpha(2.0)
            estimator.setVariationalRefinementIterations(2)
        flow = estimator.calc(*grey, None)
        if factor > 1:
            flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / factor
        return torch.from_numpy(flow).movedim(-1, 0)


def whole_factor(height: int, width: int, min_side_px: int) -> int:
    """Returns the smallest whole factor that makes both sides at least `min_side_px`."""
    return max(1, math.ceil(min_side_px / min(height, width)))


def _opencv() -> Any:  # Any, as OpenCV's type stubs lack DISOpticalFlow_create
    require("flow estimated by DIS", "flow", "cv2")
    import cv2

    return cv2


class RAFT(nn.Module):
    """Recurrent all-pairs field transforms (Teed and Deng, 2020): flow by torchvision's network.

    It runs on the device of its weights. Small pictures are enlarged by a whole factor and the flow
    is scaled back to their pixels. Sides that aren't multiples of 8 are padded by repeating the
    border, and the padding is cut off again. Where hardly anything moves, it is noisier than DIS.

    Args:
        weights: a file with the network's state dict, `.safetensors` or `.pth`, read without
            unpickling objects, such as the weights that torchvision publishes.
        network: `"raft_small"` or `"raft_large"`, as the weights need.
        min_side_px: see `DIS`; at least 128.

    Raises:
        ValueError: the file holds no weights, or not those of the network.
        ImportError: torchvision is missing, or was built for another torch.
    """

    def __init__(
        self, weights: str | Path, network: str = "raft_small", min_side_px: int = SMALLEST_SIDE_PX
    ) -> None:
        super().__init__()
        check_name("network", network, Network)
        self.min_side_px = checked_count("min_side_px", min_side_px, SMALLEST_SIDE_PX)
        state = _read_weights(Path(weights))
        self.network = getattr(_optical_flow(), network)(weights=None)
        try:
            self.network.load_state_dict(state)
        except (RuntimeError, TypeError) as error:
            raise ValueError(
                f"{weights} does not hold the weights of {network}: {str(error)[:200]}"
            ) from error
        self.network.eval().requires_grad_(False)

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Returns the displacement of each pixel, see `DIS.__call__`."""
        height, width = first.shape[-2:]
        factor = whole_factor(height, width, self.min_side_px)
        first, second = (self._prepared(picture, factor) for picture in (first, second))
        flow = self.network(first, second)[-1]  # after torchvision's 12 refinements, the last
        flow = flow[..., : height * factor, : width * factor]
        return functional.avg_pool2d(flow, factor) / factor if factor > 1 else flow

    def train(self, mode: bool = True) -> RAFT:
        """Keeps the network in evaluation mode, even if its env is put into training mode."""
        return super().train(False)

    def _prepared(self, pictures: Tensor, factor: int) -> Tensor:
        scaled = pictures.float() / 127.5 - 1.0  # torchvision's weights expect -1 to 1
        if factor > 1:
            scaled = functional.interpolate(
                scaled, scale_factor=factor, mode="bilinear", align_corners=False
            )
        bottom, right = (-side % _MULTIPLE_PX for side in scaled.shape[-2:])
        return functional.pad(scaled, (0, right, 0, bottom), mode="replicate")


def _read_weights(path: Path) -> dict[str, Tensor]:
    try:
        if path.suffix == ".safetensors":
            require(f"'{path}'", "raft", "safetensors")
            from safetensors.torch import load_file

            return load_file(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (ImportError, OSError):
        raise
    except Exception:  # readers raise anything on a damaged file
        # "from None", as torch's text advises to load the file with pickle.
        raise ValueError(
            f"'{path}' is not a readable weights file: it is damaged, or holds more than a state "
            "dict. Save the network's state_dict() again, preferably as .safetensors"
        ) from None


def _optical_flow() -> Any:
    try:
        from torchvision.models import optical_flow
    except (ImportError, RuntimeError) as error:  # RuntimeError: built for another torch
        raise ImportError(
            "flow estimated by RAFT needs the torchvision that belongs to your torch: "
            f"pip install 'flowrep-rl[raft]' ({error})"
        ) from error
    return optical_flow


class EstimatedFlow(FlowTransform):
    """Optical flow estimated between the last two pictures.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"rgb2"`, uint8 `[*B,6,kH,kW]` | `"raw"` | float32 `[*B, 2, H, W]` | any | px/step × `scale` |
    | with `intrinsics`: | `"unscaled"` if chosen | as above | any | px/step |
    | `("sensor", "depth")`, m | `"raw_valid"`, `"unscaled_valid"` | bool `[*B, 1, H, W]` | | |
    | `("sensor", "prev_from_curr")` | | | | |

    Convention: as in `RawFlow`, on the current frame's grid. The estimator therefore runs from the
    current picture to the previous one, and its flow is negated. Flow from the previous picture to
    the current one would be on the previous frame's grid.

    The input is the previous picture and, behind it on the channels, the current one.
    `FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=["rgb2"])` writes them, correctly across
    resets and in a replay buffer. Pictures may be k = `picture_scale` times as large as the maps;
    their flow is then averaged. After a reset both pictures are the same and flow is exactly 0.
    Where the estimator's flow isn't finite, it is 0 and the mask beside it False.

    With `intrinsics` the camera's motion is compensated: the estimator sees the previous picture
    warped by ego flow, and its estimate, the objects' flow, is added to ego flow. Estimates are
    then small even if the camera moves fast. An estimate counts only where it explains the picture
    clearly better than ego flow does. Plain surfaces, the sky and what the previous picture didn't
    show thus have ego flow alone.

    Args:
        estimator: `"dis"`, `"raft_small"` or `"raft_large"` (which need `weights`), or a function
            from two batches of pictures, uint8 `[N, 3, H, W]`, to the flow from the first to the
            second, float `[N, 2, H, W]`, e.g. a configured `flowrep.transforms.DIS`. The next
            three options are not for functions.
        weights: file with RAFT's weights, see `flowrep.transforms.RAFT`.
        preset: of DIS, see `flowrep.transforms.DIS`; RAFT doesn't read it.
        min_side_px: see `flowrep.transforms.DIS`; RAFT uses at least 128.
        intrinsics: K `[3, 3]` of the maps, or its key; see `RawFlow`, as for `prev_intrinsics`.
            If None, the camera's motion is not compensated.
        picture_scale: k, the pictures' size over the maps'.
        outputs: which of `"raw"` and `"unscaled"` to write.
        scale: factor on raw; for `out_keys` see `RawFlow`.
        in_keys: the pair of pictures; with `intrinsics` also depth and the camera's motion.

    Raises:
        ValueError: an option is invalid; in calls, the pictures aren't `picture_scale` times as
            large as the maps, or the estimator's flow has the wrong shape.

    Example:
        A texture that moved 2 px to the right since the previous picture.

        >>> from tensordict import TensorDict
        >>> noise = torch.rand(1, 3, 8, 12, generator=torch.Generator().manual_seed(0))
        >>> texture = torch.nn.functional.interpolate(255 * noise, scale_factor=8.0)
        >>> now = texture[0].to(torch.uint8)
        >>> pair = torch.cat([now.roll(-2, -1), now])  # the previous picture, then the current one
        >>> u, v = EstimatedFlow()(TensorDict({"rgb2": pair}))["raw"]
        >>> u.median().round()
        tensor(2.)
    """

    known = masked = ("raw", "unscaled")
    needs_camera = False

    def __init__(
        self,
        estimator: str | Estimator = "dis",
        *,
        weights: str | Path | None = None,
        preset: str = DIS.preset,
        min_side_px: int = DIS.min_side_px,
        intrinsics: Intrinsics | None = None,
        prev_intrinsics: NestedKey | None = None,
        picture_scale: int = 1,
        outputs: Sequence[str] = ("raw",),
        scale: float = 1.0,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        reads, keys = [PICTURE_PAIR], ["rgb2"]
        if intrinsics is not None:
            reads, keys = [*reads, base.DEPTH, base.MOTION], [*keys, *EGO_KEYS]
        keys = keys if in_keys is None else in_keys
        if scale != 1.0 and "raw" not in outputs:
            raise ValueError(f"scale={scale} is for raw, which outputs={list(outputs)} lacks")
        scales = {name: scale if name == "raw" else 1.0 for name in outputs}
        options: Any = {"outputs": outputs, "scale": scales, "prev_intrinsics": prev_intrinsics}
        super().__init__(intrinsics, reads, keys, out_keys, **options)
        self.estimator = _estimator(estimator, weights, preset, min_side_px)
        self.picture_scale = checked_count("picture_scale", picture_scale)

    def compute(self, pair: Tensor, *camera: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from the pictures (and depth, camera motion and K)."""
        batch, size = pair.shape[:-3], pair.shape[-2:]
        self._map_size(pair, *camera)
        previous, current = pair.to(torch.uint8).reshape(-1, 6, *size).chunk(2, -3)
        # After a reset both pictures are the same. Nothing moves by itself, whatever an estimator
        # says.
        differs = (current != previous).flatten(1).any(1).reshape(-1, 1, 1, 1)
        if camera:
            _, depth, motion, K, prev_K = self._at_one_precision([pair, *camera])
            ego, seen = geometry.ego_flow(depth, K, motion, prev_K=prev_K)
            ego = ego.float().reshape(-1, 2, *ego.shape[-2:])
            seen = seen.reshape(-1, 1, *ego.shape[-2:])
            flow = self._compensated(current, previous, ego, seen)
            # Pictures of a plain wall are the same, too, though the camera moves.
            flow = torch.where(differs, flow, torch.where(seen, ego, math.nan))
        else:
            flow = torch.where(differs, self._averaged(self._estimate(current, previous)), 0.0)
        known = flow.isfinite().all(-3, keepdim=True)
        flow, known = (
            x.reshape(*batch, *x.shape[-3:]) for x in (torch.where(known, flow, 0.0), known)
        )
        return self._chosen({"raw": flow, "unscaled": flow}, known)

    def _compensated(self, current: Tensor, previous: Tensor, ego: Tensor, seen: Tensor) -> Tensor:
        """Returns ego flow, plus estimates that explain the pictures better, `[N, 2, H, W]`."""
        smooth = self._enlarged(ego, seen)  # [N, 2, kH, kW], as all that follows
        sources = _sources(smooth)
        warped = _sampled(previous.float(), sources)
        estimate = self._estimate(current, warped.round().to(torch.uint8))
        # With an estimate e, the warped picture shows at p - e what the previous one shows at p - e
        # - ego(p - e). Beyond ego(p), the pixel has therefore moved by e + ego(p - e) - ego(p).
        moved = _sources(estimate)
        beyond = estimate + _sampled(smooth, moved) - smooth
        # Without texture, and where something has just come into view, an estimate is a guess.
        misfit = _misfit(current, _sampled(warped, moved))
        is_moving = misfit < _MISFIT_SHARE * _misfit(current, warped) - _ROUNDING_GREY_LEVELS**2
        is_moving &= (sources.abs() <= 1).all(-1).unsqueeze(1)  # the previous picture showed it
        # An estimate that isn't finite is kept, so that the mask can say so.
        beyond = torch.where(is_moving | ~estimate.isfinite(), beyond, 0.0)
        return torch.where(seen, ego, self._averaged(smooth)) + self._averaged(beyond)

    def _enlarged(self, ego: Tensor, seen: Tensor) -> Tensor:
        """Returns ego flow in the pictures' size and pixels; holes take their neighbours' flow.

        It is interpolated: flow that is constant in each pixel of the maps would warp the picture
        in steps, which an estimator takes for motion.
        """
        k = self.picture_scale
        flow, weight = (
            functional.interpolate(x, scale_factor=k, mode="bilinear")
            for x in (ego * seen, seen.float())
        )
        return k * flow / weight.clamp(min=1e-6)

    def _averaged(self, flow: Tensor) -> Tensor:
        """Returns the pictures' flow in the maps' size and pixels."""
        return functional.avg_pool2d(flow, self.picture_scale) / self.picture_scale

    def _estimate(self, current: Tensor, previous: Tensor) -> Tensor:
        """Returns flow `[N, 2, kH, kW]`, float32, from the previous picture to the current one."""
        flow = self.estimator(current, previous)
        expected = (len(current), 2, *current.shape[-2:])
        if flow.shape != expected:
            raise ValueError(
                f"representation {self.label}: the estimator should return [N, 2, H, W], "
                f"{[*expected]}, got {list(flow.shape)}; if channels come last, as OpenCV's do, "
                "return flow.movedim(-1, 1)"
            )
        return -flow.to(torch.float32)

    def output_specs(self, pair: TensorSpec, *camera: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec for each flow and a boolean one for each mask."""
        size = (*pair.shape[:-2], *self._map_size(pair, *camera))
        return super().output_specs(Unbounded(size, device=pair.device, dtype=pair.dtype))

    def _map_size(self, pair: Tensor | TensorSpec, *camera: Tensor | TensorSpec) -> tuple[int, int]:
        """Returns height and width of the maps; raises ValueError if the pictures don't fit."""
        k, (height, width) = self.picture_scale, pair.shape[-2:]
        maps = camera[0].shape[-2:] if camera else (height // k, width // k)
        if (height, width) != (k * maps[0], k * maps[1]):
            what = f"maps of {maps[0]}x{maps[1]}" if camera else "maps"
            raise ValueError(
                f"representation {self.label}: pictures of {height}x{width} are not "
                f"picture_scale={k} times as large as {what}"
            )
        return maps[0], maps[1]


def _misfit(current: Tensor, shown: Tensor) -> Tensor:
    """Returns the pictures' mean squared difference around each pixel, `[N, 1, H, W]`."""
    squared = (current - shown).square().mean(1, keepdim=True)
    return _around(squared) / _around(torch.ones_like(squared[:1]))


def _around(maps: Tensor) -> Tensor:
    """Returns the sum over the 5 × 5 pixels around each, with 0 beyond the border."""
    # Row by row: avg_pool2d takes ten times as long on a CPU.
    padded = functional.pad(maps, (2, 2, 2, 2))
    return padded.unfold(-2, 5, 1).sum(-1).unfold(-1, 5, 1).sum(-1)


def _sources(flow: Tensor) -> Tensor:
    """Returns p - flow for each pixel p, `[N, H, W, 2]`, -1 to 1 from border to border."""
    height, width = flow.shape[-2:]
    still = torch.eye(2, 3, device=flow.device, dtype=flow.dtype).unsqueeze(0)
    pixels = functional.affine_grid(still, [1, 1, height, width], align_corners=False)
    return pixels - flow.movedim(1, -1) * (2 / flow.new_tensor([width, height]))


def _sampled(maps: Tensor, points: Tensor) -> Tensor:
    """Returns float maps `[N, C, H, W]` at points; beyond the border, the nearest pixel's value."""
    return functional.grid_sample(maps, points, padding_mode="border", align_corners=False)


def _estimator(
    estimator: str | Estimator, weights: str | Path | None, preset: str, min_side_px: int
) -> Estimator:
    if isinstance(estimator, str) and estimator in get_args(Network):
        if weights is None:
            raise ValueError(f"estimator {estimator!r} needs weights=, a file with its state dict")
        return RAFT(weights, estimator, min_side_px=max(min_side_px, SMALLEST_SIDE_PX))
    if weights is not None:
        raise ValueError(f"weights= is for RAFT; estimator {estimator!r} has no weights")
    if not callable(estimator):
        check_name("estimator", estimator, Literal["dis", Network])
        return DIS(preset, min_side_px)
    if (preset, min_side_px) != (DIS.preset, DIS.min_side_px):
        raise ValueError(
            f"preset={preset!r} and min_side_px={min_side_px} are not read if the estimator is "
            "a function: set them in it, e.g. estimator=DIS(preset, min_side_px)"
        )
    return estimator
