"""The picture of a run's learning curve; a report's figures have those of several runs."""

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path

from flowrep.experiment.outcomes import outcome_shares
from flowrep.files import replace_file


def draw_learning_curve(
    path: Path,
    metrics: Iterable[Mapping[str, str]],
    episodes: Iterable[Mapping[str, str]],
    *,
    speed: str,
    fps: float,
) -> None:
    """Draws a run's success over frames, from the rows of metrics.csv and evaluation.csv.

    The line is the success rate over the last training episodes (sampled actions); the points are
    the run's greedy evaluations at its speed and frame rate, with 95 % Wilson intervals. If a
    training evaluation and the final one share a frame count, only the final one is drawn.
    """
    from matplotlib.figure import Figure  # the import takes a tenth of a command's start

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(
        xlabel="environment frames", ylabel="share of episodes that succeed", ylim=(0, 1)
    )
    points = [(int(row["frames"]), float(row["success"])) for row in metrics]
    axes.plot(*zip(*points) if points else ([], []), label="training, sampled actions")
    outcomes: dict[str, dict[int, list[str]]] = {kind: {} for kind in ("training", "final")}
    for row in episodes:
        is_own = row["evaluation"] in outcomes and row["policy"] == "greedy"
        if is_own and (row["speed"], float(row["fps"])) == (speed, fps):
            of_kind = outcomes[row["evaluation"]]
            of_kind.setdefault(int(row["frames"]), []).append(row["outcome"])
    evaluations = outcomes["training"] | outcomes["final"]
    for number, (frames, names) in enumerate(sorted(evaluations.items())):
        share, low, high = outcome_shares(names)["success"]
        axes.errorbar(
            frames,
            share,
            [[share - low], [high - share]],
            fmt="o",
            color="C1",
            capsize=3,
            clip_on=False,  # an agent may succeed always
            label=None if number else "evaluation, greedy actions",
        )
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)  # covers no curve
    axes.grid(alpha=0.3)
    replace_file(path, partial(figure.savefig, dpi=120, format="png"))
