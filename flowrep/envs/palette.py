"""The one table of classes: name, id in the semantic map, colour in every picture."""

from typing import NamedTuple

import numpy as np


class Category(NamedTuple):
    """A class of surface: its id is its place in `CATEGORIES`."""

    name: str
    rgb: tuple[int, int, int]


CATEGORIES: tuple[Category, ...] = (
    Category("sky", (112, 178, 232)),
    Category("road", (84, 84, 92)),
    Category("sidewalk", (196, 176, 160)),
    Category("building", (150, 84, 60)),
    Category("pedestrian", (222, 40, 60)),
    Category("terrain", (112, 158, 74)),
    Category("crosswalk", (238, 234, 220)),
    Category("tree", (36, 104, 48)),
    Category("fence", (214, 148, 70)),
    Category("car", (46, 64, 196)),
    Category("traffic_light", (250, 214, 40)),
)
CATEGORY_ID: dict[str, int] = {category.name: i for i, category in enumerate(CATEGORIES)}
PALETTE_RGB = np.array([category.rgb for category in CATEGORIES], dtype=np.uint8)  # [classes, 3]


def num_classes(categories: tuple[str, ...]) -> int:
    """Returns how many ids a semantic map of these categories needs (largest id plus one).

    >>> num_classes(("sky", "road", "sidewalk", "building", "pedestrian"))
    5
    """
    return 1 + max(CATEGORY_ID[name] for name in categories)
