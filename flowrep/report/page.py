"""A self-contained HTML page of a report, with the drives and films that evaluations saved."""

import base64
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from flowrep.config.cli import line_for
from flowrep.experiment.run import DRIVES, read_drives
from flowrep.files import TableError
from flowrep.report.figures import encoded, words
from flowrep.report.runs import Run, groups_of, scenes_of
from flowrep.report.sections import Report
from flowrep.report.tables import listed
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.layout import Layout
from flowrep.viz.plan import Track, draw_plan

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=lambda name: name is not None and name.endswith(".html.jinja"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


class EmbeddedPicture(NamedTuple):
    """A plan or a film of one agent."""

    title: str
    caption: str
    data: str  # a data URI


class PlansAndFilms(NamedTuple):
    """Plans by scene, films by episode, and a warning for each run without them."""

    plans: dict[str, list[EmbeddedPicture]]
    films: dict[str, list[EmbeddedPicture]]
    warnings: list[str]


def plans_and_films_of(runs: Sequence[Run], *, trajectories: int, videos: int) -> PlansAndFilms:
    """Returns a plan of drives, and films, of one agent of each group, scene and stack.

    Args:
        runs: the runs; those with the lowest seed are shown.
        trajectories: the number of drives in a plan.
        videos: the number of films of an agent.
    """
    drives = PlansAndFilms({}, {}, [])
    # One agent of each: plans and films of all seeds would make a page of hundreds of megabytes.
    shown: dict[Any, Run] = {}
    for number, group in enumerate(groups_of(runs)):
        for run in sorted(group.runs, key=lambda run: run.seed):
            if run.is_trained:
                shown.setdefault((number, run.scene, run.stack), run)
    for run in shown.values():
        scene, title = words(run.scene), f"{run.stack}, seed {run.seed} ({Path(run.name).name})"
        tracks = tracks_of(run, trajectories)
        if tracks:
            try:
                layout = Layout(load_scene(run.config["scene"]))
            except SceneError as error:
                drives.warnings.append(f"{run.name} has no plan: {error}")
            else:
                ends = Counter(track.outcome.replace("_", " ") for track in tracks)
                ended = ", ".join(f"{number} {outcome}" for outcome, number in ends.items())
                uri = data_uri("image/png", encoded(draw_plan(layout, tracks), "png", 150))
                plan = EmbeddedPicture(title, f"drives: {ended}", uri)
                drives.plans.setdefault(scene, []).append(plan)
        elif trajectories:
            drives.warnings.append(f"{run.name} has no {DRIVES} with greedy drives: no plan")
        films = films_of(run)[:videos]
        for film in films:
            picture = EmbeddedPicture(title, film.name, data_uri("video/mp4", film.read_bytes()))
            drives.films.setdefault(f"{scene}, {words(film.stem)}", []).append(picture)
        if videos and not films:
            remedy = f": {line_for('evaluate', run=run.name)} video=1" if run.folder else ""
            drives.warnings.append(f"{run.name} has no films{remedy}")
    return drives


def tracks_of(run: Run, count: int) -> list[Track]:
    """Returns a run's first greedy drives, if any, at its training speed and frame rate."""
    if run.folder is None or not count:
        return []
    try:
        drives = read_drives(run.folder / DRIVES)
    except TableError:
        return []
    here = {*run.episodes["scene_id"][run.tested].tolist()}  # not drives through another scene
    tracks = {}
    for drive, (outcome, positions) in drives.items():
        as_trained = ("greedy", run.speed, run.fps) == (drive.policy, drive.speed, drive.fps)
        is_final = drive.evaluation != "training" and drive.frames >= run.total_frames
        if as_trained and is_final and drive.scene_id in here:
            # By seed, as two evaluations may have driven the same episode.
            tracks[drive.episode_seed] = Track(positions.astype(float), outcome)
    return [tracks[seed] for seed in sorted(tracks)[:count]]


def films_of(run: Run) -> list[Path]:
    """Returns the films in a run's folder, except links to files outside of it."""
    if run.folder is None:
        return []
    # A link in a stranger's folder could put any file of this machine into the page.
    home, films = run.folder.resolve(), sorted(run.folder.glob("videos/*.mp4"))
    return [film for film in films if film.is_file() and film.resolve().is_relative_to(home)]


def data_uri(kind: str, data: bytes) -> str:
    """Returns a file's content for embedding in a page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def render_page(report: Report, drives: PlansAndFilms) -> str:
    """Returns the page of a report as HTML."""
    runs, stacks = report.runs, sorted({run.stack for run in report.runs})
    what = listed(stacks) if len(stacks) < 4 else f"{len(stacks)} stacks"
    rows = []
    for run in runs:
        named = (run.name, run.config.get("experiment") or "", words(run.scene), run.stack)
        frames, episodes = f"{run.frames:,} of {run.total_frames:,}", f"{run.tested.sum():,}"
        rows.append((*named, str(run.seed), frames, episodes))
    return TEMPLATES.get_template("page.html.jinja").render(
        title=f"{what} in {listed([words(scene) for scene in scenes_of(runs)])}",
        summary=summary(runs),
        report=report,
        drawn=lambda figure: data_uri("image/svg+xml", encoded(figure, "svg")),
        drives=drives,
        runs=rows,
    )


def summary(runs: Sequence[Run]) -> str:
    """Returns a sentence on the runs that were read."""
    trained, episodes = sum(r.is_trained for r in runs), sum(r.tested.sum() for r in runs)
    stacks, scenes = sorted({run.stack for run in runs}), map(words, scenes_of(runs))
    return (
        f"Runs: {len(runs)}, {trained} of them trained to the end; stacks: {listed(stacks)}, in "
        f"{listed([*scenes])}; evaluated episodes: {episodes:,}, those of baselines included."
    )
