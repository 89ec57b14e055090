"""What a film shows besides maps: the steering, the outcome of the episode, and a legend."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from flowrep.viz.maps import Image, Tile, class_legend, flow_wheel, strip, written

_WHEEL_PX = 60
_RIM_PX = 6
_RIM, _ARROW = (250, 250, 250), (255, 210, 0)
_TEXT_PX = 15
_LINE_PX = 19


def steering(turned: float, sign: float = 0.0, background: Image | None = None) -> Image:
    """Returns a steering wheel between two arrows, `[60, 120, 3]`.

    Args:
        turned: the yaw rate as a share of the largest, positive to the left; at 1 the wheel is
            turned by 90° to the left.
        sign: of the chosen action, positive to the left; 0 draws no arrow.
        background: an image of the same size to draw on; grey if None.
    """
    from PIL import Image as pillow
    from PIL import ImageDraw

    if background is None:
        background = np.full((_WHEEL_PX, 2 * _WHEEL_PX, 3), 90, np.uint8)
    fine = 4  # drawn larger and scaled down, as Pillow draws without antialiasing
    width, height = fine * 2 * _WHEEL_PX, fine * _WHEEL_PX
    picture = pillow.fromarray(background).resize((width, height))
    draw, x, y = ImageDraw.Draw(picture), width / 2, height / 2
    radius = height / 2 - 2 * fine
    for thickness, colour in ((_RIM_PX + 2, (20, 20, 20)), (_RIM_PX, _RIM)):
        inset = radius - fine * (_RIM_PX - thickness) / 2
        box = (x - inset, y - inset, x + inset, y + inset)
        draw.ellipse(box, outline=colour, width=fine * thickness)
        for spoke_deg in (0, 180, 270):  # right, left and down; counter-clockwise is left
            angle = math.radians(spoke_deg + 90 * turned)
            rim = x + math.cos(angle) * radius * 0.9, y - math.sin(angle) * radius * 0.9
            draw.line((x, y, *rim), fill=colour, width=fine * (thickness - 1))
    if sign:
        side = -math.copysign(1, sign)  # left is -x
        tip, base = x + side * (radius + fine * 26), x + side * (radius + fine * 6)
        arrow = [(tip, y), (base, y - fine * 14), (base, y + fine * 14)]
        draw.polygon(arrow, fill=_ARROW, outline=(20, 20, 20), width=fine)
    return np.asarray(picture.resize((2 * _WHEEL_PX, _WHEEL_PX), pillow.Resampling.BOX))


def with_steering(image: Image, turned: float, sign: float = 0.0) -> Image:
    """Returns an image with a steering wheel in the middle of its lower edge, if there is room."""
    height, width = image.shape[:2]
    top, left = height - _WHEEL_PX - 6, (width - 2 * _WHEEL_PX) // 2
    if top < 0 or left < 0:
        return image
    area = slice(top, top + _WHEEL_PX), slice(left, left + 2 * _WHEEL_PX)
    image = image.copy()
    image[area] = steering(turned, sign, image[area])
    return image


def legend_strip(
    tiles: Mapping[str, Tile],
    size: tuple[int, int],
    *,
    keys: Mapping[str, Image],
    framed: Collection[str] = (),
    categories: Iterable[str] = (),
) -> Image:
    """Returns a strip whose tiles explain what a strip of the same size shows.

    Args:
        tiles: those of the strip, by name.
        size: height and width of its tiles.
        keys: by name, a picture below the explanation; flow has the wheel of its colours.
        framed: names of tiles with a frame.
        categories: classes whose colours are explained below.
    """
    wheel = flow_wheel(min(size) // 2)
    pages = {
        tile.label: _page(size, tile.about, wheel if tile.is_flow else keys.get(name))
        for name, tile in tiles.items()
    }
    notes = {tile.label: tile.note for tile in tiles.values() if tile.note}
    labels = [tile.label for name, tile in tiles.items() if name in framed]
    drawn = strip(pages, notes=notes, framed=labels)
    return np.concatenate([drawn, class_legend(tuple(categories), drawn.shape[1])])


def _page(size: tuple[int, int], text: str, key: Image | None) -> Image:
    """Returns wrapped text on white, and a picture in the middle of the space below."""
    height, width = size
    page = np.full((height, width, 3), 255, np.uint8)
    lines = textwrap.wrap(text, max(10, width // 8))
    if key is not None:
        top = _LINE_PX * len(lines) + 12
        key = key[: max(0, height - top), :width]
        left = (width - key.shape[1]) // 2
        top += (height - top - len(key)) // 2
        page[top : top + len(key), left : left + key.shape[1]] = key
    texts = {
        (6, 8 + _LINE_PX // 2 + _LINE_PX * i): (line, "lm", (40, 40, 40))
        for i, line in enumerate(lines)
    }
    return written(page, texts, size=_TEXT_PX) if texts else page
