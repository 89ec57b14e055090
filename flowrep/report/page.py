"""A self-contained HTML page of a report."""

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from flowrep.report.cell_text import listed
from flowrep.report.figures import encoded, words
from flowrep.report.runs import Run, scenes_of
from flowrep.report.sections import Report

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    # The page is HTML; the paper's, which is Markdown, must keep its "<" and "&".
    autoescape=lambda name: name is not None and name.endswith(".html.jinja"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def render_page(report: Report) -> str:
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
        drawn=_data_uri,
        runs=rows,
    )


def _data_uri(figure: Figure) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(encoded(figure, 'svg')).decode('ascii')}"


def summary(runs: Sequence[Run]) -> str:
    """Returns a sentence on the runs that were read."""
    trained, episodes = sum(r.is_trained for r in runs), sum(r.tested.sum() for r in runs)
    stacks, scenes = sorted({run.stack for run in runs}), map(words, scenes_of(runs))
    return (
        f"Runs: {len(runs)}, {trained} of them trained to the end; stacks: {listed(stacks)}, in "
        f"{listed([*scenes])}; evaluated episodes: {episodes:,}, those of baselines included."
    )
