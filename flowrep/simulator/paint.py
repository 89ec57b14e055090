"""The small texture shared by all meshes: a row of plain colours, then house fronts."""

import numpy as np
from numpy.typing import NDArray

SIZE_PX = 256
_SWATCH_PX = 8
_FRONT_PX = (60, 64)  # height, width of one house front in the texture
_FLOORS = (2, 3, 4, 5)

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

# (u0, v0, u1, v1): a rectangle of the texture, v downwards.
Patch = tuple[float, float, float, float]


def swatch(name: str) -> Patch:
    """Returns the middle of a plain colour, as a patch of zero size."""
    u = (list(PAINTS).index(name) + 0.5) * _SWATCH_PX / SIZE_PX
    v = 0.5 * _SWATCH_PX / SIZE_PX
    return (u, v, u, v)


def front(variant: int) -> Patch:
    """Returns the patch of house front `variant`, modulo the number of fronts."""
    row, column = divmod(variant % NUM_FRONTS, len(_WALLS))
    top = _SWATCH_PX + row * _FRONT_PX[0]
    left = column * _FRONT_PX[1]
    pixels = np.array([left + 0.5, top + 0.5, left + _FRONT_PX[1] - 0.5, top + _FRONT_PX[0] - 0.5])
    u0, v0, u1, v1 = (pixels / SIZE_PX).tolist()
    return (u0, v0, u1, v1)


def upper_storeys(variant: int) -> Patch:
    """Returns a house front above its ground floor, for walls without a door."""
    u0, v0, u1, v1 = front(variant)
    floors = _FLOORS[variant % NUM_FRONTS // len(_WALLS)]
    return (u0, v0, u1, v1 - (v1 - v0) / floors)


def picture() -> NDArray[np.uint8]:
    """Returns the texture [SIZE_PX, SIZE_PX, 3]."""
    image = np.zeros((SIZE_PX, SIZE_PX, 3), dtype=np.uint8)
    for i, rgb in enumerate(PAINTS.values()):
        image[:_SWATCH_PX, i * _SWATCH_PX : (i + 1) * _SWATCH_PX] = rgb
    height, width = _FRONT_PX
    for row, floors in enumerate(_FLOORS):
        for column, rgb in enumerate(_WALLS):
            top, left = _SWATCH_PX + row * height, column * width
            image[top : top + height, left : left + width] = _house_front(floors, rgb)
    return image


def _house_front(floors: int, rgb: tuple[int, int, int]) -> NDArray[np.uint8]:
    height, width = _FRONT_PX
    image = np.full((height, width, 3), rgb, dtype=np.uint8)
    storey, bay = height // floors, width // 4
    for floor in range(floors):
        top = floor * storey + storey // 4
        image[floor * storey] = np.array(rgb) * 0.8
        for column in range(4):
            left = column * bay + bay // 4
            image[top : top + storey // 2, left : left + bay // 2] = PAINTS["glass"]
    # A door in the second bay of the ground floor, down to the street.
    image[height - storey * 2 // 3 :, bay + bay // 4 : 2 * bay - bay // 4] = PAINTS["wood"]
    return image
