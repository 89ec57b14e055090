"""Paint: plain colours and house fronts, and the grain on every surface.

The rasteriser multiplies colours by the grain, so that flow can be estimated on roads and clothes,
too; on plain asphalt, estimated flow is 0.
"""

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.scenes.scene import CATEGORY_ID

_FRONT_PX = (60, 64)  # height, width of a house front's picture
_FLOORS = (2, 3, 4, 5)
# Shares of ambient light and of sunlight, and the direction to the sun in the world.
AMBIENT, DIFFUSE = 0.62, 0.46
LIGHT = tuple((np.array([-4.0, 3.0, 9.0]) / np.linalg.norm([-4.0, 3.0, 9.0])).tolist())

GRAIN_SIZE, FRONT_SIZE = 512, 64  # texels per side, of the grain and of the rasteriser's fronts
# With these, the grain of roads repeats every 20 m. That of people repeats every 2.6 m, because
# they are small in the picture but must show texture, too.
_TEXELS_A_M, _PEOPLE_TEXELS_A_M = 25.0, 200.0
_SLOPE = 1.2  # exponent of the grain's spectrum; at 1 every octave has the same contrast
_COARSEST_WAVES = 5  # number of the longest waves over the grain's size; they are 4 m long on roads
# The standard deviation of the grain, as a share of the colour. It suffices for DIS to follow roads
# and people (docs/scenes.md), which still look like asphalt and clothes. A slope of 0.8 doubles the
# error on roads; contrasts of 1 increase that on people.
_CONTRAST_OF = {"road": 0.3, "crosswalk": 0.3, "sidewalk": 0.2, "terrain": 0.3, "tree": 0.3}
_CONTRAST_OF |= {"pedestrian": 0.3, "building": 0.12, "fence": 0.2}
_CONTRAST = [_CONTRAST_OF.get(name, 0.1) for name in CATEGORY_ID]  # by class

SKY = (112, 178, 232)  # the colour of the sky, which `flowrep.viz` uses for maps, too
PAINTS: dict[str, tuple[int, int, int]] = {
    "asphalt": (84, 84, 90),
    "lane_mark": (226, 222, 206),
    "paving": (178, 168, 156),
    "skin": (224, 176, 144),
    "trousers": (44, 52, 84),
    "shirt_red": (196, 52, 52),
    "shirt_green": (58, 140, 84),
    "shirt_yellow": (222, 178, 60),
    "shirt_blue": (60, 104, 190),
    "roof": (92, 66, 58),
    "grass": (110, 150, 74),
    "leaf": (48, 112, 56),
    "wood": (128, 92, 60),
    "metal": (90, 94, 100),
    "car_body": (52, 84, 168),
    "glass": (60, 76, 92),
    "hair": (66, 48, 36),
    "shoe": (34, 30, 30),
    "tyre": (30, 30, 34),
    "car_red": (170, 44, 44),
    "car_white": (222, 222, 218),
    "car_grey": (120, 124, 130),
    "leaf_light": (92, 146, 62),
    "lamp_white": (250, 244, 214),
    "lamp_red": (230, 48, 40),
    "lamp_green": (60, 200, 96),
    "lamp_off": (52, 46, 44),
    "kerb": (214, 210, 202),
}
SHIRTS = tuple(name for name in PAINTS if name.startswith("shirt"))
_WALLS = ((178, 108, 80), (206, 186, 150), (150, 152, 158), (190, 146, 108))
NUM_FRONTS = len(_WALLS) * len(_FLOORS)


class Patch(NamedTuple):
    """What a rectangle shows: a plain colour, or a part of a house front, v downwards."""

    paint: int  # a colour's place in `PAINTS`; from `len(PAINTS)` on, a front's number
    u0: float = 0.0  # texels of the front, of `FRONT_SIZE`
    v0: float = 0.0
    u1: float = 0.0
    v1: float = 0.0


def swatch(name: str) -> Patch:
    """Returns a plain colour."""
    return Patch(list(PAINTS).index(name))


def front(variant: int) -> Patch:
    """Returns a variant's house front; there are `NUM_FRONTS`, which repeat."""
    # From the centre of the picture's first pixel to that of its last.
    u0, u1, v0, v1 = [
        FRONT_SIZE * at / side for side in _FRONT_PX[::-1] for at in (0.5, side - 0.5)
    ]
    return Patch(len(PAINTS) + variant % NUM_FRONTS, u0, v0, u1, v1)


def upper_storeys(variant: int) -> Patch:
    """Returns a house front above its ground floor, for walls without a door."""
    whole = front(variant)
    floors = _FLOORS[variant % NUM_FRONTS // len(_WALLS)]
    return whole._replace(v1=whole.v1 - (whole.v1 - whole.v0) / floors)


def _front_pictures() -> NDArray[np.uint8]:
    """Returns the house fronts [NUM_FRONTS, H, W, 3]."""
    images = np.zeros((NUM_FRONTS, *_FRONT_PX, 3), dtype=np.uint8)
    for image, (floors, rgb) in zip(images, product(_FLOORS, _WALLS)):
        _paint_front(image, floors, rgb)
    return images


def _paint_front(image: NDArray[np.uint8], floors: int, rgb: tuple[int, int, int]) -> None:
    image[:] = rgb
    storey, bay = len(image) // floors, image.shape[1] // 4
    for floor in range(floors):
        top = floor * storey + storey // 4
        image[floor * storey] = np.array(rgb) * 0.8
        for left in range(bay // 4, 4 * bay, bay):
            image[top : top + storey // 2, left : left + bay // 2] = PAINTS["glass"]
    # A door in the second bay of the ground floor, down to the street.
    image[-(storey * 2 // 3) :, bay + bay // 4 : 2 * bay - bay // 4] = PAINTS["wood"]


class Painted(NamedTuple):
    """The appearance of T triangles, in the coordinates of their bodies."""

    normals: NDArray[np.float32]  # [T, 3]
    colours: NDArray[np.float32]  # [T, 3], 0 to 255
    contrast: NDArray[np.float32]  # [T], standard deviation of the grain
    grain_from_point: NDArray[np.float32]  # [T, 2, 4], texels of the grain from (x, y, z, 1)
    fronts: NDArray[np.int32]  # [T], the house front; -1 for a plain colour
    front_from_point: NDArray[np.float32]  # [T, 2, 4], texels of the house front


def painted(
    corners: NDArray[np.float64],  # [T, 3, 3], metres, counter-clockwise seen from outside
    paints: NDArray[np.int64],  # [T], see `Patch`
    texels: NDArray[np.float64],  # [T, 3, 2], the corners' positions on a house front
    semantic: NDArray[np.uint8],  # [T]
    instance: NDArray[np.uint8],  # [T], 0 for the static world
) -> Painted:
    """Returns the appearance of triangles."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(a, b)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # On level ground, the grain's axes are the world's, so that it continues from triangle to
    # triangle. On other faces, its axes are the horizontal direction in the face and the one
    # across.
    is_level = np.abs(normals[:, 2]) > 0.9
    along = np.stack([-normals[:, 1], normals[:, 0], np.zeros(len(a))], axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)  # 0 if level
    along[is_level] = 1.0, 0.0, 0.0
    across = np.cross(normals, along)
    across[is_level] = 0.0, 1.0, 0.0
    per_m = np.where(instance > 0, _PEOPLE_TEXELS_A_M, _TEXELS_A_M)
    # Offsets by the face's distance from the origin (in metres) and by instance, so that parallel
    # faces and different people don't show the same part of the grain. The numbers are arbitrary.
    plane_m = np.where(is_level, 0.0, (normals * corners[:, 0]).sum(axis=1))
    grain_axes = np.zeros((len(a), 2, 4))
    grain_axes[:, 0, :3], grain_axes[:, 1, :3] = per_m[:, None] * along, per_m[:, None] * across
    grain_axes[:, 0, 3] = 37.7 * per_m * plane_m + 97.0 * instance
    grain_axes[:, 1, 3] = 17.3 * per_m * plane_m + 61.0 * instance
    is_front = paints >= len(PAINTS)
    colours = np.array([*PAINTS.values()], dtype=np.float32)
    # The affine map from a triangle's points to texels. Its linear part [2, 3] maps the edges a and
    # b to their differences in texels, and the normal n to 0: steps · [a b n]⁻¹.
    front_axes = np.zeros((len(a), 2, 4))
    for i in np.flatnonzero(is_front):
        first, second, third = texels[i]
        steps = np.column_stack([second - first, third - first, np.zeros(2)])
        front_axes[i, :, :3] = steps @ np.linalg.inv(np.column_stack([a[i], b[i], normals[i]]))
        front_axes[i, :, 3] = first - front_axes[i, :, :3] @ corners[i, 0]
    return Painted(
        normals.astype(np.float32),
        colours[np.where(is_front, 0, paints)],
        np.array(_CONTRAST, dtype=np.float32)[semantic],
        grain_axes.astype(np.float32),
        np.where(is_front, paints - len(PAINTS), -1).astype(np.int32),
        front_axes.astype(np.float32),
    )


@cache
def grain() -> NDArray[np.float32]:
    """Returns a periodic random pattern of mean 0 and deviation 1, and its coarser levels.

    Level l has texels 2^l times as large. It is the pattern after a Gaussian blur of half such a
    texel, which prevents aliasing. The levels are in one array `[2 * GRAIN_SIZE, GRAIN_SIZE, 2]`,
    see `_below_each_other`; the second channel is the next level's value at the same point, so that
    one look-up can blend two levels.
    """
    frequency = np.fft.fftfreq(GRAIN_SIZE)  # cycles a texel
    radius = np.hypot(frequency[:, None], frequency)
    noise = np.random.default_rng(0).standard_normal((GRAIN_SIZE, GRAIN_SIZE))
    # White noise with an amplitude of 1 / f^slope, without waves longer than a few metres, because
    # large areas would differ in colour.
    spectrum = np.fft.fft2(noise) / np.maximum(radius, 1 / GRAIN_SIZE) ** _SLOPE
    spectrum[radius < _COARSEST_WAVES / GRAIN_SIZE] = 0.0
    spectrum /= np.fft.ifft2(spectrum).real.std()
    levels, size = [], GRAIN_SIZE
    while size >= 2:
        # A smaller level keeps the lower half of the frequencies: cropping the spectrum resamples.
        kept = np.ix_(*[np.r_[0 : size // 2, GRAIN_SIZE - size // 2 : GRAIN_SIZE]] * 2)
        texel = GRAIN_SIZE / size
        pair = [
            np.fft.ifft2(spectrum[kept] * np.exp(-2 * (np.pi * sigma * radius[kept]) ** 2)).real
            for sigma in (texel / 2, texel)
        ]
        levels.append(np.stack(pair, axis=-1) / texel**2)
        size //= 2
    return _below_each_other(levels)


@cache
def front_levels() -> NDArray[np.float32]:
    """Returns the house fronts with grain: `[fronts, 2 * FRONT_SIZE, FRONT_SIZE, 3]`."""
    pictures, fronts = _front_pictures().astype(np.float32), []
    pattern = grain()[:GRAIN_SIZE, :, 0]
    rows = ((np.arange(FRONT_SIZE) + 0.5) * _FRONT_PX[0] / FRONT_SIZE).astype(int)
    for number in range(NUM_FRONTS):
        row, column = divmod(number, len(_WALLS))
        level = pictures[number, rows]
        # Every fourth texel of the grain, so that its waves are as long as on the ground.
        waves = pattern[row * 16 :: 4, column * 16 :: 4][:FRONT_SIZE, :FRONT_SIZE, None]
        levels = [level * (1.0 + _CONTRAST[CATEGORY_ID["building"]] * waves)]
        while half := len(levels[-1]) // 2:
            levels.append(levels[-1].reshape(half, 2, half, 2, 3).mean(axis=(1, 3)))
        fronts.append(_below_each_other(levels))
    return np.stack(fronts)


def _below_each_other(levels: list[NDArray[np.float64]]) -> NDArray[np.float32]:
    """Returns square levels of halved sizes in one array; one of n rows begins at 2 (size - n)."""
    size = len(levels[0])
    together = np.zeros((2 * size, *levels[0].shape[1:]), dtype=np.float32)
    for level in levels:
        top = 2 * (size - len(level))
        together[top : top + len(level), : len(level)] = level
    return together
