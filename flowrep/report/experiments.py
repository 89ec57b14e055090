"""The experiments: what each compares, and how to know it in a folder of runs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from flowrep.report.runs import Run

SCENES = ("straight_road", "s_turn", "h_shaped_pathways", "three_way_junction")
"""The paper's scenes in its order."""


@dataclass(frozen=True)
class Experiment:
    """A comparison of stacks.

    Args:
        name: as in conf/experiment/ and in the names of files.
        title: as a heading.
        stacks: what is compared, in the figure's order.
        pairs: whose differences the paper speaks of: the first is said to do better.
        speeds: pedestrians' speed modes of the figure; None for all that were evaluated.
    """

    name: str
    title: str
    stacks: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    speeds: tuple[str, ...] | None = None

    def is_in(self, runs: Sequence[Run]) -> bool:
        """Says whether runs are of it, by what they see; its name alone will do for the first."""
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
    ),
)
FAILURE_STACKS = ("ego+obj", "depth2", "seg2", "ego+obj+depth2", "ego+obj+seg2", _BOTH)
"""In the order of the paper's Table III."""


@dataclass(frozen=True)
class Variation:
    """A comparison of configs that differ in one part: stacks with it and without it.

    Args:
        name: as in conf/experiment/ and in the names of files.
        title: as a heading.
        part: what the keys of `Run.identity` begin with in which its runs may differ.
        stacks: in the figure's order; others come after them.
        variants: what a run can be, in the figure's order; others come after them.
        variant_of: says which of them a run is.
    """

    name: str
    title: str
    part: str
    stacks: tuple[str, ...]
    variants: tuple[str, ...]
    variant_of: Callable[[Run], str]

    def is_in(self, differing: Iterable[str]) -> bool:
        """Says whether configs are of it, by the keys in which they differ."""
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
