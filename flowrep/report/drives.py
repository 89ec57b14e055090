"""Plans and films of agents' episodes, as a page shows them."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Plan:
    """A scene from above with the drives of one agent: whose, how they ended, a data URI."""

    title: str
    told: str
    picture: str


@dataclass(frozen=True)
class FilmPart:
    """One agent's film of an episode: whose, how it ended, a data URI."""

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
    """What is seen of drives.

    Args:
        plans: by the scene's title.
        films: episodes, each driven by several agents.
        complaints: a line for each agent that could not be driven.
    """

    plans: dict[str, list[Plan]] = field(default_factory=dict)
    films: list[Film] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
