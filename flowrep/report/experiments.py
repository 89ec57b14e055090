"""The experiments: what each compares, and how to recognise it among runs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from flowrep.report.runs import Run

SCENES = ("straight_road", "s_turn", "h_shaped_pathways", "three_way_junction")
"""The paper's scenes in its order."""


@dataclass(frozen=True)
class Experiment:
    """A comparison of stacks.

    Args:
        name: the name in conf/experiment/ and of files.
        title: the heading.
        stacks: the compared stacks, in the figure's order.
        pairs: the differences to list, as (first, second) of first minus second.
        speeds: pedestrians' speed modes of the figure; None for all that were evaluated.
    """

    name: str
    title: str
    stacks: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    speeds: tuple[str, ...] | None = None

    def is_in(self, runs: Sequence[Run]) -> bool:
        """Returns whether runs have two of its stacks, or one if they were made as this one."""
        found = {run.stack for run in runs} & set(self.stacks)
        named = any(run.config.get("experiment") == self.name for run in runs)
        return len(found) > 1 or bool(found and named)


_BOTH = "ego+obj+seg2+depth2"

FLOW_COMPOSITION = Experiment(
    "flow_composition",
    "Composition of the flow maps",
    ("ego", "raw", "obj", "ego+obj"),
    (("ego+obj", "ego"), ("ego+obj", "raw"), ("ego+obj", "obj"), ("raw", "ego")),
    ("low", "high"),
)
COMPLEMENTARY = Experiment(
    "complementary",
    "Flow beside segmentation and depth",
    ("seg2", "depth2", "ego+obj", "ego+obj+seg2", "ego+obj+depth2", _BOTH),
    (
        ("ego+obj+seg2", "seg2"),
        ("ego+obj+depth2", "depth2"),
        ("ego+obj+seg2", "ego+obj"),
        ("ego+obj+depth2", "ego+obj"),
        (_BOTH, "ego+obj"),
        ("ego+obj", "seg2"),
        ("ego+obj", "depth2"),
    ),
)
FAILURE_STACKS = ("ego+obj", "depth2", "seg2", "ego+obj+depth2", "ego+obj+seg2", _BOTH)
"""In the order of the paper's Table III."""


@dataclass(frozen=True)
class Variation:
    """A comparison of configs that differ in one part: stacks with it and without it.

    Args:
        name: the name in conf/experiment/ and of files.
        title: the heading.
        part: the prefix of those keys of `Run.identity` in which its runs may differ.
        stacks: the stacks in the figure's order; others come after them.
        variants: the variants in the figure's order; others come after them.
        variant_of: returns the variant of a run.
    """

    name: str
    title: str
    part: str
    stacks: tuple[str, ...]
    variants: tuple[str, ...]
    variant_of: Callable[[Run], str]

    def is_in(self, differing: Iterable[str]) -> bool:
        """Returns whether configs belong to it, by the keys in which they differ."""
        keys = list(differing)
        return bool(keys) and all(key.startswith(self.part) for key in keys)


ESTIMATED_FLOW = Variation(
    "estimated_flow",
    "Flow estimated from pictures",
    "flow.",
    ("raw", "ego+obj"),
    ("exact", "estimated"),
    lambda run: run.config["flow"]["source"],
)
SENSOR_NOISE = Variation(
    "sensor_noise",
    "Noise of depth and odometry",
    "noise.",
    ("ego+obj", "raw", "depth2"),
    ("exact", "noisy"),
    lambda run: "noisy" if any(run.config["noise"].values()) else "exact",
)
RESOLUTION = Variation(
    "resolution",
    "Resolution of the maps",
    "scene.camera.",
    ("ego+obj", "seg2", "depth2"),
    ("48 px", "84 px"),
    lambda run: f"{run.config['scene']['camera']['height_px']} px",
)
VARIATIONS = (ESTIMATED_FLOW, SENSOR_NOISE, RESOLUTION)
"""flowrep's own experiments."""

STACKS = tuple(dict.fromkeys((*FLOW_COMPOSITION.stacks, *COMPLEMENTARY.stacks)))
"""All of the paper's, in the order of its figures."""
