"""Plans and films of agents' episodes, as a page shows them."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Plan:
    """A scene from above with one agent's drives: its name, the outcomes, a data URI."""

    title: str
    told: str
    picture: str


@dataclass(frozen=True)
class FilmPart:
    """One agent's film of an episode: its name, the outcome, a data URI."""

    title: str
    told: str
    film: str


@dataclass(frozen=True)
class Film:
    """An episode, driven by several agents."""

    title: str
    parts: tuple[FilmPart, ...]


@dataclass(frozen=True)
class Drives:
    """Plans and films of drives.

    Args:
        plans: plans by the scene's title.
        films: episodes, each driven by several agents.
        complaints: a line for each agent that could not drive.
    """

    plans: dict[str, list[Plan]] = field(default_factory=dict)
    films: list[Film] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
