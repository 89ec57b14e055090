"""Pictures of representations: maps in colour, strips of them, and PNG files.

Nothing is normalised per image: a colour means the same in every frame and every figure. Maps are
numpy arrays or torch tensors `[C, H, W]`, images are numpy uint8 `[H, W, 3]`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.files import replace_file

Image = NDArray[np.uint8]

FLOW_SCALE_PX: dict[str, float] = {"raw": 20.0, "ego": 20.0, "obj": 5.0}
"""Flow magnitude in pixels at which a representation's colour is fully saturated."""

DEPTH_RANGE_M = 100.0

CLASS_COLOURS: dict[str, tuple[int, int, int]] = {
    "sky": (112, 178, 232),
    "road": (84, 84, 92),
    "sidewalk": (196, 176, 160),
    "building": (150, 84, 60),
    "pedestrian": (222, 40, 60),
    "terrain": (112, 158, 74),
    "crosswalk": (238, 234, 220),
    "tree": (36, 104, 48),
    "fence": (214, 148, 70),
    "car": (46, 64, 196),
    "traffic_light": (250, 214, 40),
}
"""Class name to colour, in the order of the class ids (`flowrep.scenes.CATEGORY_ID`)."""

OUTCOME_COLOURS = {
    "success": "#0072b2",
    "collision": "#d55e00",
    "out_of_bounds": "#cc79a7",
    "timeout": "#f0c000",
}
"""Colour of each outcome in every figure, safe for colour-blind readers (Okabe and Ito)."""

_UNKNOWN = (128, 128, 128)
# Near to far, as in matplotlib's magma_r, but without the need for matplotlib. The dark end is next
# to the black that means no surface.
_DEPTH_COLOURS = np.array(
    [(252, 253, 191), (254, 176, 120), (241, 96, 93), (183, 55, 121), (104, 28, 129), (40, 16, 80)],
    dtype=np.float32,
)
# What a fully saturated hue subtracts from white, by direction [_HUES, 3]. In HSV at full value,
# each channel is a trapezoid over hue, and the three channels are a third of a turn apart.
_HUES = 6 * 4096
_OFF_WHITE = 255 * (
    1 - np.clip(np.abs((6 * np.arange(_HUES)[:, None] / _HUES + (0, 4, 2)) % 6 - 3) - 1, 0, 1)
).astype(np.float32)
_BAR_PX = 28
_NOTE_PX = 20
_CLASS_PX = 120
_GAP_PX = 4
_GAP_GREY = 200  # between images, so that the white of no motion has a visible edge
_FRAME_PX, _FRAME_COLOUR = 5, (230, 97, 1)
_NOTE_COLOUR = (70, 70, 70)
_TILE_PX = 240


def flow_to_rgb(flow: Any, scale_px: float) -> Image:
    """Returns flow as colour: direction is hue, magnitude is saturation on white.

    Convention: right is red, down is yellow-green, left is cyan, up is violet. Saturation is the
    square root of magnitude over `scale_px`, clipped at 1, so that a tenth of a pixel is visible
    next to tens of pixels. Flow that is not finite is grey.

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
    rgb = (255.5 - off_white).astype(np.uint8)  # + 0.5, so that truncation rounds
    rgb[~known] = _UNKNOWN
    return rgb


def flow_wheel(size_px: int) -> Image:
    """Returns the legend of `flow_to_rgb`: a disc whose rim is the scale."""
    axis = np.linspace(-1, 1, size_px, dtype=np.float32)
    u, v = np.meshgrid(axis, axis)
    disc = flow_to_rgb(np.stack([u, v]), scale_px=1.0)
    # Half a pixel beyond the rim, which would be ragged otherwise.
    disc[np.hypot(u, v) > 1 + 1 / size_px] = 255
    return disc


def classes_to_rgb(semantic: Any) -> Image:
    """Returns class ids, `semantic` `[1, H, W]`, as `CLASS_COLOURS`; unknown ids are grey."""
    ids = _channels("semantic", semantic, 1)[0].astype(int)
    palette = np.array([*CLASS_COLOURS.values(), _UNKNOWN], dtype=np.uint8)
    is_known = (ids >= 0) & (ids < len(CLASS_COLOURS))
    return palette[np.where(is_known, ids, -1)]


def grey_to_rgb(values: Any, low: float = -1.0, high: float = 1.0) -> Image:
    """Returns a map `[1, H, W]` in grey, black at `low` and below, white at `high` and above."""
    share = (_channels("a map", values, 1)[0].astype(np.float32) - low) / (high - low)
    grey = np.rint(255 * np.clip(np.nan_to_num(share), 0, 1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def depth_to_rgb(depth: Any, range_m: float = DEPTH_RANGE_M) -> Image:
    """Returns depth `[1, H, W]` in metres as colour, near light and far dark, logarithmically.

    The colour is constant beyond `range_m`; inf (no surface) is black, nan (missing) is grey.
    """
    metres = _channels("depth", depth, 1)[0].astype(np.float32)
    surface = np.isfinite(metres)
    share = np.log1p(np.clip(np.where(surface, metres, 0.0), 0, range_m)) / np.log1p(range_m)
    stops = np.linspace(0, 1, len(_DEPTH_COLOURS))
    rgb = np.stack([np.interp(share, stops, channel) for channel in _DEPTH_COLOURS.T], -1)
    rgb[~surface] = 0
    rgb[np.isnan(metres)] = _UNKNOWN
    return np.rint(rgb).astype(np.uint8)


class Tile(NamedTuple):
    """How a map is drawn."""

    label: str
    draw: Callable[[Any], Image]  # takes the map [C, H, W]
    note: str = ""  # below the label
    is_flow: bool = False  # whether it has the colours of `flow_to_rgb`


def stock_tiles(
    *, flow_scale_px: Mapping[str, float] = FLOW_SCALE_PX, depth_range_m: float = DEPTH_RANGE_M
) -> dict[str, Tile]:
    """Returns the tiles of rgb, seg, depth and flow, in the order in which they are drawn."""
    depth_colours = partial(depth_to_rgb, range_m=depth_range_m)
    tiles = {
        "rgb": Tile("RGB", _picture),
        "seg": Tile("segmentation", classes_to_rgb),
        "depth": Tile("depth, logarithmic", depth_colours, depth_note(depth_range_m)),
    }
    for name, scale_px in {**FLOW_SCALE_PX, **flow_scale_px}.items():
        draw = partial(flow_to_rgb, scale_px=scale_px)
        tiles[name] = Tile(f"{name} flow", draw, flow_note(scale_px), is_flow=True)
    return tiles


def representation_strip(
    maps: Mapping[str, Any],
    *,
    tiles: Mapping[str, Tile] | None = None,
    framed: Collection[str] = (),
    flow_scale_px: Mapping[str, float] = FLOW_SCALE_PX,
    depth_range_m: float = DEPTH_RANGE_M,
    categories: Iterable[str] = (),
) -> Image:
    """Returns the camera's picture and its representations side by side, labelled.

    Args:
        maps: any of rgb (uint8), seg (ids), depth (metres), raw, ego, obj (pixels), each
            `[C, H, W]`; drawn in this order, other keys are ignored.
        tiles: how maps are drawn, by name; `stock_tiles` of the two arguments below if None.
        framed: names of maps with a frame around them.
        flow_scale_px: flow at full saturation for raw, ego and obj; printed below them.
        depth_range_m: end of the depth colours; printed below them.
        categories: classes whose colours are explained below the strip.

    Raises:
        ValueError: a map has the wrong shape, or none of the names is present.
    """
    if tiles is None:
        tiles = stock_tiles(flow_scale_px=flow_scale_px, depth_range_m=depth_range_m)
    shown = {name: tile for name, tile in tiles.items() if name in maps.keys()}  # noqa: SIM118
    if not shown:
        given = sorted(map(str, maps.keys()))
        raise ValueError(f"nothing to draw: maps has {given}, expected some of {list(tiles)}")
    drawn = strip(
        {tile.label: tile.draw(maps[name]) for name, tile in shown.items()},
        wheel_for=[tile.label for tile in shown.values() if tile.is_flow],
        notes={tile.label: tile.note for tile in shown.values() if tile.note},
        framed=[tile.label for name, tile in shown.items() if name in framed],
    )
    return np.concatenate([drawn, class_legend(tuple(categories), drawn.shape[1])])


@lru_cache(maxsize=64)
def class_legend(names: tuple[str, ...], width: int) -> Image:
    """Returns the colours and names of classes, in as many rows as the width needs."""
    columns = max(1, width // _CLASS_PX)
    legend = np.full((-(-len(names) // columns) * _NOTE_PX, width, 3), 255, np.uint8)
    texts = {}
    for number, name in enumerate(names):
        row, column = divmod(number, columns)
        x, y = column * _CLASS_PX, row * _NOTE_PX
        legend[y + 4 : y + 16, x + 2 : x + 14] = CLASS_COLOURS[name]
        texts[x + 18, y + _NOTE_PX // 2] = name.replace("_", " "), "lm", _NOTE_COLOUR
    return written(legend, texts, size=14) if names else legend


def flow_note(scale_px: float) -> str:
    """Returns the legend of saturation at a scale; it is the square root of the magnitude."""
    return f"full at {scale_px:g} px, half at {scale_px / 4:g} px"


def depth_note(range_m: float) -> str:
    """Returns the legend of depth up to a range."""
    return f"light is near, dark {range_m:g} m or more"


def strip(
    images: Mapping[str, Image],
    *,
    wheel_for: Collection[str] = (),
    notes: Mapping[str, str] = MappingProxyType({}),
    framed: Collection[str] = (),
) -> Image:
    """Returns images side by side, each under its label.

    The smallest are enlarged by `tile_zoom`, and all others, such as an estimator's larger
    pictures, to the same size, without interpolation.

    Args:
        images: by label, `[H, W, 3]`.
        wheel_for: labels that have the flow wheel next to them.
        notes: by label, the text below it.
        framed: labels with a frame around label and image.

    Raises:
        ValueError: the images differ in their ratio of height to width.
    """
    sizes = sorted({image.shape[:2] for image in images.values()})
    height, width = sizes[0]
    if any(h * width != w * height for h, w in sizes):
        raise ValueError(f"a strip needs images of one ratio of height to width, got {sizes}")
    zoom = tile_zoom(height, width)
    height, width = zoom * height, zoom * width
    columns: list[Image] = []
    for label, image in images.items():
        title = text_bar(label, width, _BAR_PX, size=18).copy()
        if label in wheel_for and width >= _BAR_PX:
            title[1 : _BAR_PX - 1, -_BAR_PX:-2] = flow_wheel(_BAR_PX - 2)
        column = [title, resized(image, height, width)]
        if notes.keys() & images.keys():  # below all labels, so that all images stand level
            bar = text_bar(notes.get(label, ""), width, _NOTE_PX, colour=_NOTE_COLOUR)
            column.insert(1, bar)
        whole = np.concatenate(column)
        if framed:
            size = len(whole) + 2 * _FRAME_PX, whole.shape[1] + 2 * _FRAME_PX, 3
            frame = np.full(size, _FRAME_COLOUR if label in framed else 255, np.uint8)
            frame[_FRAME_PX:-_FRAME_PX, _FRAME_PX:-_FRAME_PX] = whole
            whole = frame
        columns += [whole, np.full((len(whole), _GAP_PX, 3), _GAP_GREY, np.uint8)]
    return np.concatenate(columns[:-1], axis=1)


def resized(image: Image, height: int, width: int) -> Image:
    """Returns an image in another size, without interpolation."""
    rows, columns = (np.arange(n) * m // n for n, m in zip((height, width), image.shape))
    return image.take(rows, axis=0).take(columns, axis=1)


def tile_zoom(height: int, width: int) -> int:
    """Returns the factor by which a strip enlarges images of this size."""
    return max(1, round(_TILE_PX / max(height, width)))


def contact_sheet(rows: Iterable[Image]) -> Image:
    """Returns images stacked vertically, with narrower ones padded with white."""
    rows = list(rows)
    width = max(row.shape[1] for row in rows)
    fills = [((0, _GAP_PX), (0, width - row.shape[1]), (0, 0)) for row in rows]
    filled = [np.pad(row, fill, constant_values=255) for row, fill in zip(rows, fills)]
    return np.concatenate(filled)[:-_GAP_PX]


def write_png(path: str | Path, image: Image) -> None:
    """Writes an image `[H, W, 3]` in place of an earlier one, creating its folder if needed."""
    from PIL import Image as pillow

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replace_file(Path(path)) as file:
        pillow.fromarray(image).save(file)


@lru_cache(maxsize=64)
def text_bar(
    text: str,
    width: int,
    height: int,
    *,
    size: int = 14,
    colour: tuple[int, int, int] = (0, 0, 0),
    background: tuple[int, int, int] = (255, 255, 255),
) -> Image:
    """Returns a line of text on a bar of a colour."""
    bar = np.full((height, width, 3), background, np.uint8)
    return written(bar, {(2, height // 2): (text, "lm", colour)}, size=size)


def written(image: Image, texts: Mapping[tuple[int, int], tuple[Any, ...]], *, size: int) -> Image:
    """Returns an image with texts, each (text, Pillow's anchor, colour) by its position (x, y)."""
    from PIL import Image as pillow
    from PIL import ImageDraw, ImageFont

    picture = pillow.fromarray(image)
    font, draw = ImageFont.load_default(size=size), ImageDraw.Draw(picture)
    for position, (text, anchor, colour) in texts.items():
        draw.text(position, text, fill=colour, font=font, anchor=anchor)
    return np.array(picture)


def _picture(rgb: Any) -> Image:
    picture = np.moveaxis(_channels("rgb", rgb, 3), 0, -1)
    if picture.dtype.kind == "f":
        raise ValueError(f"rgb must be uint8, 0 to 255, got {picture.dtype}")
    return picture.astype(np.uint8)


def _channels(name: str, values: Any, channels: int) -> NDArray[Any]:
    if hasattr(values, "detach"):  # a torch tensor, without importing torch
        values = values.detach().cpu().numpy()
    array = np.asarray(values)
    if array.ndim != 3 or array.shape[0] != channels:
        raise ValueError(f"{name} must be [{channels}, H, W], got {list(array.shape)}")
    return array
