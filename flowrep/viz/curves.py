"""Pictures of a run, drawn from its tables."""

from collections import defaultdict

from flowrep.experiment.evaluation import outcome_shares
from flowrep.experiment.run import RunFolder


def draw_learning_curve(run: RunFolder) -> None:
    """Draws success over frames into learning_curve.png, from metrics.csv and evaluation.csv.

    The line is the success rate over the last training episodes (sampled actions); the points are
    greedy evaluations at the training speed and frame rate, with 95 % Wilson intervals.
    """
    from matplotlib.figure import Figure  # a tenth of the time that a command takes to start

    metrics = run.read_metrics()
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(
        xlabel="environment frames", ylabel="share of episodes that succeed", ylim=(0, 1)
    )
    frames = [int(row["frames"]) for row in metrics]
    axes.plot(frames, [float(row["success"]) for row in metrics], label="training, sampled actions")
    for number, (at, low, share, high) in enumerate(_evaluated(run)):
        axes.errorbar(
            at,
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
    whole = run.curve_path.with_suffix(".tmp")
    figure.savefig(whole, dpi=120, format="png")
    whole.replace(run.curve_path)


def _evaluated(run: RunFolder) -> list[tuple[int, float, float, float]]:
    """Returns frames, lower end, success rate and upper end of the run's greedy evaluations.

    Rows added by flowrep.evaluate, at any frame rate and in any scene, are left out.
    """
    config = run.read_config()
    trained_at = config["speed"], float(config["scene"]["frame_rate_hz"])
    outcomes = defaultdict(list)
    for row in run.read_episodes():
        is_own = row["evaluation"] in ("training", "final") and row["policy"] == "greedy"
        if is_own and (row["speed"], float(row["fps"])) == trained_at:
            outcomes[int(row["frames"])].append(row["outcome"])
    points = []
    for frames, names in sorted(outcomes.items()):
        share, low, high = outcome_shares(names)["success"]
        points.append((frames, low, share, high))
    return points
