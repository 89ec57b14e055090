"""Drives and films that evaluations left in run folders, for a page to show.

`drives.npz` beside evaluation.csv holds where the vehicle was in each evaluated episode:
`positions` [sum of T, 2] in world metres, `starts` [N + 1] (episode n is
`positions[starts[n]:starts[n + 1]]`), and for each episode `evaluation`, `policy`, `speed`, `fps`,
`frames`, `episode_seed` and `outcome` as in evaluation.csv.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from flowrep.report.figures import data_uri, png_uri, words
from flowrep.report.runs import Run, groups_of
from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout
from flowrep.viz.plan import Track, draw_plan

DRIVES = "drives.npz"
_DPI = 100


class Picture(NamedTuple):
    """A plan or a film of one agent: its name, what it shows, a data URI."""

    title: str
    caption: str
    data: str


class Drives(NamedTuple):
    """Plans by the scene's title, films by the episode's name, and a line for each run without."""

    plans: dict[str, list[Picture]]
    films: dict[str, list[Picture]]
    warnings: list[str]


def drives_of(runs: Sequence[Run], *, trajectories: int, videos: int) -> Drives:
    """Returns plans and films of one finished agent of each scene, stack and group.

    Args:
        runs: the runs of a report.
        trajectories: the number of episodes in a plan, none without plans.
        videos: the number of films of each agent, none without films.
    """
    drives = Drives({}, {}, [])
    for run in _one_of_each(runs):
        title = f"{run.stack}, seed {run.seed} ({run.folder.name})" if run.folder else run.name
        if trajectories:
            tracks = tracks_of(run, trajectories)
            if tracks:
                plans = drives.plans.setdefault(words(run.scene), [])
                plans.append(_plan(run, title, tracks))
            else:
                drives.warnings.append(f"{run.name} has no {DRIVES} with greedy drives: no plan")
        films = sorted(run.folder.glob("videos/*.mp4"))[:videos] if run.folder else []
        for film in films:
            shown = drives.films.setdefault(f"{words(run.scene)}, {words(film.stem)}", [])
            shown.append(Picture(title, film.name, data_uri("video/mp4", film.read_bytes())))
        if videos and not films:
            drives.warnings.append(
                f"{run.name} has no films: python -m flowrep.evaluate run={run.name} video=true"
            )
    return drives


def _one_of_each(runs: Sequence[Run]) -> Iterable[Run]:
    """Yields the finished run of the lowest seed of each scene and stack in each group."""
    for group in groups_of(runs):
        found: dict[tuple[str, str], Run] = {}
        for run in sorted(group.runs, key=lambda run: run.seed):
            if run.is_finished:
                found.setdefault((run.scene, run.stack), run)
        yield from found.values()


def tracks_of(run: Run, count: int) -> list[Track]:
    """Returns a run's first greedy drives at its training speed and frame rate, none without."""
    path = (run.folder or Path()) / DRIVES
    if run.folder is None or not path.is_file():
        return []
    try:
        with np.load(path) as saved:
            ours = (saved["policy"] == "greedy") & (saved["speed"] == run.speed)
            ours &= (saved["fps"] == run.fps) & (saved["frames"] >= run.total_frames)
            ours &= saved["evaluation"] != "training"
            chosen = np.flatnonzero(ours)
            chosen = chosen[np.argsort(saved["episode_seed"][chosen], kind="stable")][:count]
            positions, starts, outcomes = saved["positions"], saved["starts"], saved["outcome"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return []
    return [
        Track(positions[starts[n] : starts[n + 1]].astype(float), str(outcomes[n]))
        for n in chosen.tolist()
    ]


def _plan(run: Run, title: str, tracks: Sequence[Track]) -> Picture:
    counts = Counter(track.outcome for track in tracks)
    ended = ", ".join(f"{number} {outcome.replace('_', ' ')}" for outcome, number in counts.items())
    figure = draw_plan(Layout(load_scene(run.config["scene"])), tracks)
    return Picture(title, f"{len(tracks)} drives: {ended}", png_uri(figure, _DPI))
