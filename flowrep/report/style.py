"""The look of figures: one colour per stack in every figure, safe for colour-blind readers."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl

COLUMN_IN, PAGE_IN = 3.5, 7.16
"""Widths of a paper's column and page in inches."""


@dataclass(frozen=True)
class Theme:
    """The colours of the page that a figure stands on."""

    name: str
    ground: str
    text: str
    faint: str


LIGHT = Theme("light", "#ffffff", "#1b1f24", "#6b7480")
DARK = Theme("dark", "#16191d", "#e6e9ec", "#98a2ad")

# Okabe and Ito's colours for single maps and for the two flows. A map added to the flows has its
# own hue, darker on white and lighter on black, and a hatch or a dashed line.
_COLOURS = {
    "ego": "#e69f00",
    "raw": "#56b4e9",
    "obj": "#009e73",
    "ego+obj": "#0072b2",
    "seg2": "#d55e00",
    "depth2": "#cc79a7",
}
_ADDED = {
    "ego+obj+seg2": {"light": "#8a3c00", "dark": "#ffb27a", "hatch": "////"},
    "ego+obj+depth2": {"light": "#7d3f66", "dark": "#efbfdc", "hatch": "\\\\\\\\"},
    "ego+obj+seg2+depth2": {"light": "#4a4a4a", "dark": "#d0d0d0", "hatch": "xxxx"},
}
_DARK = {"ego+obj": "#2f8fd6"}  # on black its own blue is too faint for a line
_OTHERS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_HATCHES = ("", "////", "xxxx", "....")
_OF_VARIANTS = ("", "......", "++++", "||||")  # no stack uses them
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "p")

_TITLES = {
    "straight_road": "Straight Road",
    "s_turn": "S-Turn",
    "h_shaped_pathways": "H-Shaped Pathways",
    "three_way_junction": "Three-Way Junction",
}


@dataclass(frozen=True)
class Look:
    """How a series is drawn: its colour, its bars' hatch, its line's marker and dashes."""

    colour: str
    hatch: str
    marker: str

    @property
    def dashes(self) -> Literal["-", "--"]:
        """The line's style, dashed if the bar is hatched."""
        return "--" if self.hatch else "-"


def looks(names: Sequence[str], theme: Theme) -> dict[str, Look]:
    """Returns how each series of a figure is drawn.

    The paper's stacks look the same in all figures, and keep their colour under several configs
    ("ego, noisy"). If other names are among them, colours are assigned in turn.
    """
    parts = {name: name.partition(", ")[::2] for name in names}
    known = all(stack in _COLOURS or stack in _ADDED for stack, _ in parts.values())
    places = {name: place for place, name in enumerate((*_COLOURS, *_ADDED))}
    variants = list(dict.fromkeys(variant for _, variant in parts.values()))
    found = {}
    for turn, name in enumerate(names):
        if known:
            stack, variant = parts[name]
            added = _ADDED.get(stack)
            colour = added[theme.name] if added else _COLOURS[stack]
            if theme.name == "dark":
                colour = _DARK.get(stack, colour)
            hatch = _OF_VARIANTS[variants.index(variant) % len(_OF_VARIANTS)]
            hatch = hatch or (added["hatch"] if added else "")
            found[name] = Look(colour, hatch, _MARKERS[places[stack]])
        else:
            hatch = _HATCHES[turn // len(_OTHERS) % len(_HATCHES)]
            colour = _OTHERS[turn % len(_OTHERS)]
            found[name] = Look(colour, hatch, _MARKERS[turn % len(_MARKERS)])
    return found


def saving() -> AbstractContextManager[None]:
    """Makes saved figures reproducible byte for byte, with text as text in PDF."""
    settings: Any = {"svg.hashsalt": "flowrep", "pdf.fonttype": 42, "hatch.linewidth": 0.7}
    return mpl.rc_context(settings)


@contextmanager
def styled(theme: Theme, font_pt: float) -> Iterator[None]:
    """Draws figures for a theme."""
    settings: Any = {
        "font.size": font_pt,
        "axes.titlesize": font_pt + 0.5,
        "axes.labelsize": font_pt,
        "xtick.labelsize": font_pt - 0.5,
        "ytick.labelsize": font_pt - 0.5,
        "legend.fontsize": font_pt - 0.5,
        "text.color": theme.text,
        "axes.labelcolor": theme.text,
        "axes.titlecolor": theme.text,
        "axes.edgecolor": theme.faint,
        "xtick.color": theme.text,
        "ytick.color": theme.text,
        "axes.facecolor": theme.ground,
        "figure.facecolor": theme.ground,
        "savefig.facecolor": theme.ground,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.7,
        "grid.color": theme.faint,
        "grid.alpha": 0.35,
        "grid.linewidth": 0.5,
        "legend.frameon": False,
        "text.parse_math": False,  # $ is literal
    }
    with mpl.rc_context(settings):
        yield


def words(name: str) -> str:
    """Returns a config name as a heading; the paper's scenes are spelt as in the paper.

    >>> words("s_turn"), words("my_crossing")
    ('S-Turn', 'My crossing')
    """
    text = _TITLES.get(name, name.replace("_", " "))
    return text[:1].upper() + text[1:]
