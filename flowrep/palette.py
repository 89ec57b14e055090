"""Colours that are the same in every picture: of classes, whose ids are here too, and outcomes."""

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
"""Class name to colour; a class id is the name's place in this table."""

OUTCOME_COLOURS = {
    "success": "#0072b2",
    "collision": "#d55e00",
    "out_of_bounds": "#cc79a7",
    "timeout": "#f0c000",
}
"""Colour of each outcome in every figure, safe for colour-blind readers (Okabe and Ito)."""

CATEGORY_ID: dict[str, int] = {name: i for i, name in enumerate(CLASS_COLOURS)}


def num_classes(categories: tuple[str, ...]) -> int:
    """Returns how many ids a semantic map of these categories needs (largest id plus one).

    >>> num_classes(("sky", "road", "sidewalk", "building", "pedestrian"))
    5
    """
    return 1 + max(CATEGORY_ID[name] for name in categories)
