"""Pictures of representations: fixed scales, one class palette, strips, PNG and mp4.

Nothing here is normalised per image: a colour means the same in every frame and in every figure.
Images are numpy uint8 `[H, W, 3]`. Maps go in as numpy or torch, `[C, H, W]`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.palette import CLASS_COLOURS

Image = NDArray[np.uint8]
Note = str | Callable[[int], Image]

FLOW_SCALE_PX: dict[str, float] = {"raw": 20.0, "ego": 20.0, "obj": 5.0}
"""Flow magnitude in pixels at which a representation's colour is fully saturated."""

DEPTH_RANGE_M = 100.0

_UNKNOWN = (128, 128, 128)
# Near to far: dark ends in the black of "no surface".
_DEPTH_COLOURS = np.array(
    [(252, 253, 191), (254, 176, 120), (241, 96, 93), (183, 55, 121), (104, 28, 129), (40, 16, 80)],
    dtype=np.float32,
)
# Subtracted from white for each direction at full saturation. In HSV to RGB at full value, each
# channel is a trapezoid over hue, a third of a turn apart.
_HUES = 6 * 4096
_OFF_WHITE = 255 * (
    1 - np.clip(np.abs((6 * np.arange(_HUES)[:, None] / _HUES + (0, 4, 2)) % 6 - 3) - 1, 0, 1)
).astype(np.float32)
_BAR_PX = 28
_NOTE_PX = 20
_CLASS_PX = 120
_GAP_PX = 4
_GAP_GREY = 200  # so that the white of no motion has an edge
_TILE_PX = 240


def flow_to_rgb(flow: Any, scale_px: float) -> Image:
    """Returns flow as colour: direction is hue, magnitude is saturation on white.

    Convention: right is red, down is yellow-green, left is cyan, up is violet. Saturation is the
    square root of magnitude over `scale_px`, clipped at 1, so that a tenth of a pixel is visible
    beside tens of pixels. Flow that is not finite is grey.

    Args:
        flow: `[2, H, W]`, (u right, v down), pixels.
        scale_px: magnitude at full saturation.

    Raises:
        ValueError: flow is not `[2, H, W]`, or the scale is not positive.

    >>> flow_to_rgb(np.array([[[0.0, 2.0]], [[0.0, 0.0]]]), scale_px=2.0).tolist()
    [[[255, 255, 255], [255, 0, 0]]]
    """
    flow = _channels("flow", flow, 2).astype(np.float32, copy=False)
    if not scale_px > 0:
        raise ValueError(f"scale_px must be positive, got {scale_px}")
    known = np.isfinite(flow[0]) & np.isfinite(flow[1])
    u, v = (np.where(known, channel, np.float32(0)) for channel in flow)
    saturation = np.sqrt(np.minimum(np.hypot(u, v) / np.float32(scale_px), 1.0))
    hue = np.rint(np.arctan2(v, u) * np.float32(_HUES / (2 * np.pi))).astype(np.int32)
    off_white = _OFF_WHITE.take(hue % _HUES, axis=0) * saturation[..., None]
    rgb = (255.5 - off_white).astype(np.uint8)  # rounded
    rgb[~known] = _UNKNOWN
    return rgb


def flow_wheel(size_px: int, background: tuple[int, int, int] = (255, 255, 255)) -> Image:
    """Returns the legend of `flow_to_rgb`: a disc whose rim is the scale."""
    axis = np.linspace(-1, 1, size_px, dtype=np.float32)
    u, v = np.meshgrid(axis, axis)
    disc = flow_to_rgb(np.stack([u, v]), scale_px=1.0)
    disc[np.hypot(u, v) > 1 + 1 / size_px] = background
    return disc


def classes_to_rgb(semantic: Any) -> Image:
    """Returns class ids `[1, H, W]` in the colours of `CLASS_COLOURS`; unknown ids are grey."""
    ids = _channels("semantic", semantic, 1)[0]
    palette = np.full((256, 3), _UNKNOWN, dtype=np.uint8)
    palette[: len(CLASS_COLOURS)] = list(CLASS_COLOURS.values())
    return palette[ids.astype(np.uint8)]


def depth_to_rgb(depth: Any, range_m: float = DEPTH_RANGE_M) -> Image:
    """Returns depth `[1, H, W]` in metres as colour, near light and far dark, logarithmically.

    The colour is constant beyond `range_m`; inf (no surface) is black, nan (missing) is grey.
    """
    metres = _channels("depth", depth, 1)[0].astype(np.float32)
    surface = np.isfinite(metres)
    place = np.log1p(np.clip(np.where(surface, metres, 0.0), 0, range_m)) / np.log1p(range_m)
    stops = np.linspace(0, 1, len(_DEPTH_COLOURS))
    rgb = np.stack([np.interp(place, stops, channel) for channel in _DEPTH_COLOURS.T], -1)
    rgb[~surface] = 0
    rgb[np.isnan(metres)] = _UNKNOWN
    return np.rint(rgb).astype(np.uint8)


def representation_strip(
    maps: Mapping[str, Any],
    *,
    flow_scale_px: Mapping[str, float] = FLOW_SCALE_PX,
    depth_range_m: float = DEPTH_RANGE_M,
    categories: Iterable[str] = (),
    time_s: float | None = None,
) -> Image:
    """Returns the camera's picture and its representations side by side, labelled.

    Args:
        maps: any of rgb (uint8), semantic (ids), depth (metres), raw, ego, obj (pixels), each
            `[C, H, W]`; drawn in this order, other keys are ignored.
        flow_scale_px: flow at full saturation for raw, ego and obj; printed below them.
        depth_range_m: end of the depth colours; printed below them.
        categories: classes whose colours are explained below the strip.
        time_s: printed below RGB's label.

    Raises:
        ValueError: a map has the wrong shape, or none of the names is present.
    """
    depth_colours = partial(depth_to_rgb, range_m=depth_range_m)
    clock = "" if time_s is None else f"{time_s:.1f} s"
    tiles: dict[str, tuple[str, Callable[[Any], Image], Note]] = {
        "rgb": ("RGB", _picture, clock),
        "semantic": ("segmentation", classes_to_rgb, ""),
        "depth": ("depth, logarithmic", depth_colours, partial(depth_bar, depth_range_m)),
    }
    for name, scale_px in flow_scale_px.items():
        draw = partial(flow_to_rgb, scale_px=scale_px)
        tiles[name] = f"{name} flow", draw, flow_note(scale_px)
    names = set(maps.keys())
    images = {label: draw(maps[name]) for name, (label, draw, _) in tiles.items() if name in names}
    if not images:
        given = sorted(map(str, names))
        raise ValueError(f"nothing to draw: maps has {given}, expected some of {list(tiles)}")
    notes = {label: note for label, _, note in tiles.values() if note}
    drawn = strip(images, wheel_for=[f"{name} flow" for name in flow_scale_px], notes=notes)
    legend = class_legend(tuple(categories), drawn.shape[1])
    return np.concatenate([drawn, legend])


@lru_cache(maxsize=64)
def class_legend(names: tuple[str, ...], width: int) -> Image:
    """Returns classes' colours beside their names, in as many rows as the width asks for."""
    columns = max(1, width // _CLASS_PX)
    legend = np.full((-(-len(names) // columns) * _NOTE_PX, width, 3), 255, np.uint8)
    texts = {}
    for number, name in enumerate(names):
        row, column = divmod(number, columns)
        x, y = column * _CLASS_PX, row * _NOTE_PX
        legend[y + 4 : y + 16, x + 2 : x + 14] = CLASS_COLOURS[name]
        texts[x + 18, y + _NOTE_PX // 2] = name.replace("_", " "), "lm", (70, 70, 70)
    return _written(legend, texts, size=14) if names else legend


def flow_note(scale_px: float) -> str:
    """Returns the legend of saturation at a scale; it is the square root of the magnitude."""
    return f"full at {scale_px:g} px, half at {scale_px / 4:g} px"


def depth_bar(range_m: float, width: int) -> Image:
    """Returns a labelled bar of the depth colours from 0 m to `range_m`, on a logarithmic scale."""
    metres = np.expm1(np.linspace(0, np.log1p(range_m), width))
    bar = depth_to_rgb(metres[None, None].repeat(_NOTE_PX - 2, axis=1), range_m)
    ends = {2: ("near", "lm", (0, 0, 0)), width - 2: (f"{range_m:g} m", "rm", (255, 255, 255))}
    return _written(bar, {(x, (_NOTE_PX - 2) // 2): text for x, text in ends.items()}, size=13)


def strip(
    images: Mapping[str, Image],
    *,
    wheel_for: Iterable[str] = (),
    notes: Mapping[str, Note] = MappingProxyType({}),
) -> Image:
    """Returns images side by side, each under its label.

    The smallest are enlarged by `tile_zoom`, and larger ones, as an estimator's pictures may be, to
    the same size, all without interpolation.

    Args:
        images: by label, `[H, W, 3]`.
        wheel_for: labels with the flow wheel beside them.
        notes: by label, the note below it: a text, or a function that draws a legend of a width.
    """
    sizes = sorted({image.shape[:2] for image in images.values()})
    height, width = sizes[0]
    if any(h * width != w * height for h, w in sizes):
        raise ValueError(f"a strip needs images of one ratio of height to width, got {sizes}")
    zoom = tile_zoom(height, width)
    y, x = np.indices((zoom * height, zoom * width), sparse=True)
    with_wheel = frozenset(wheel_for)
    columns: list[Image] = []
    for label, image in images.items():
        bar = _text_bar(label, width * zoom, _BAR_PX, 18, 0).copy()
        if label in with_wheel and width * zoom >= _BAR_PX:
            bar[1 : _BAR_PX - 1, -_BAR_PX:-2] = flow_wheel(_BAR_PX - 2)
        column = [bar]
        if notes.keys() & images.keys():
            note = notes.get(label, "")
            if isinstance(note, str):
                column.append(_text_bar(note, width * zoom, _NOTE_PX, 14, 70))
            else:
                legend = note(width * zoom)
                rows = (0, _NOTE_PX - len(legend)), (0, 0), (0, 0)
                column.append(np.pad(legend, rows, constant_values=255))
        h, w = image.shape[:2]
        column.append(image[y * h // (zoom * height), x * w // (zoom * width)])
        gap = np.full((sum(map(len, column)), _GAP_PX, 3), _GAP_GREY, np.uint8)
        columns += [np.concatenate(column), gap]
    return np.concatenate(columns[:-1], axis=1)


def tile_zoom(height: int, width: int) -> int:
    """Returns by which factor a strip enlarges images of a size."""
    return max(1, round(_TILE_PX / max(height, width)))


def contact_sheet(rows: Iterable[Image]) -> Image:
    """Returns images stacked vertically, with narrower ones padded with white."""
    rows = list(rows)
    width = max(row.shape[1] for row in rows)
    fills = [((0, _GAP_PX), (0, width - row.shape[1]), (0, 0)) for row in rows]
    filled = [np.pad(row, fill, constant_values=255) for row, fill in zip(rows, fills)]
    return np.concatenate(filled)[:-_GAP_PX]


def write_png(path: str | Path, image: Image) -> None:
    """Writes an image `[H, W, 3]`, creating its folder if needed."""
    from PIL import Image as pillow

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    pillow.fromarray(image).save(path)


class Video:
    """An mp4 (H.264) that browsers play, written frame by frame, in a folder made if needed.

    Odd sizes, which the codec does not support, are padded with a white row or column. Frames of
    other sizes than the first are cut or padded.
    """

    def __init__(self, path: str | Path, *, fps: float) -> None:
        self.path, self.fps = Path(path), fps
        self._writer: Any = None
        self._size = 0, 0

    def append(self, image: Image) -> None:
        """Adds a frame `[H, W, 3]`."""
        if self._writer is None:
            import imageio.v2 as imageio

            self._size = (image.shape[0] + 1) // 2 * 2, (image.shape[1] + 1) // 2 * 2
            self.path.parent.mkdir(parents=True, exist_ok=True)
            options: Any = {"codec": "libx264", "quality": 8, "pixelformat": "yuv420p"}
            # Half the time of x264's default at the same error, and no larger.
            options |= {"output_params": ["-preset", "veryfast"], "macro_block_size": 1}
            self._writer = imageio.get_writer(self.path, fps=self.fps, **options)
        height, width = self._size
        image = image[:height, :width]
        fill = ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0))
        self._writer.append_data(np.pad(image, fill, constant_values=255))

    def close(self) -> None:
        """Completes the file; without frames there is none."""
        if self._writer is not None:
            self._writer.close()


def write_video(path: str | Path, frames: Iterable[Image], *, fps: float) -> None:
    """Writes frames `[H, W, 3]` as an mp4, see `Video`."""
    with closing(Video(path, fps=fps)) as video:
        for frame in frames:
            video.append(frame)


@lru_cache(maxsize=64)
def _text_bar(text: str, width: int, height: int, size: int, grey: int) -> Image:
    bar = np.full((height, width, 3), 255, np.uint8)
    return _written(bar, {(2, height // 2): (text, "lm", (grey, grey, grey))}, size=size)


def _written(image: Image, texts: Mapping[tuple[int, int], tuple[Any, ...]], *, size: int) -> Image:
    # Texts are (text, anchor, colour) by position (x, y).
    from PIL import Image as pillow
    from PIL import ImageDraw, ImageFont

    picture = pillow.fromarray(image)
    font, draw = ImageFont.load_default(size=size), ImageDraw.Draw(picture)
    for place, (text, anchor, colour) in texts.items():
        draw.text(place, text, fill=colour, font=font, anchor=anchor)
    return np.array(picture)


def _picture(rgb: Any) -> Image:
    return np.moveaxis(_channels("rgb", rgb, 3), 0, -1).astype(np.uint8)


def _channels(name: str, values: Any, channels: int) -> NDArray[Any]:
    if hasattr(values, "detach"):  # a torch tensor, without importing torch
        values = values.detach().cpu().numpy()
    array = np.asarray(values)
    if array.ndim != 3 or array.shape[0] != channels:
        raise ValueError(f"{name} must be [{channels}, H, W], got {list(array.shape)}")
    return array
