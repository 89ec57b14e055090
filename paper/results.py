"""The page of results: `make results` writes paper/results.md and its figures.

claims.py tests what claims.yaml declares, results.md.jinja has the words around the numbers, and
all numbers come from the packed runs. tests/test_docs.py compares the README's table with them.
"""

import csv
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jinja2 import FileSystemLoader
from matplotlib.figure import Figure
from scipy import stats

from flowrep.report.cell_text import p_text, percent, points, signed
from flowrep.report.figures import draw_bars, draw_curves, encoded, styled, words
from flowrep.report.page import TEMPLATES
from flowrep.report.runs import (
    SPEEDS,
    STACKS,
    Condition,
    Run,
    SuccessGrid,
    baseline_share,
    cell_of,
    curve_of,
    departures,
    grid_of,
    in_order,
    in_stacks,
    scores_of,
    success_rate,
)
from flowrep.report.statistics import LEVEL, Array, Effect, Estimate, effect, mean_share
from paper.archive import read_archives
from paper.claims import (
    SHORT,
    Cell,
    Claim,
    Contrast,
    HeldOut,
    Studies,
    at_length,
    beside_held_out,
    claims_of,
    conditions_of,
    contrast_of,
    held_out_cells,
    held_out_claims,
    measure_of,
    scores,
    sensitivity,
    studies_of,
    undated,
    verdict_on,
)

HERE = Path(__file__).parent
DATA, PAGE = HERE.parent / "outputs" / "reference", HERE / "results.md"
FIGURE, HELD_OUT_FIGURE = "images/results_claims.svg", "images/results_held_out.svg"
LENGTH_FIGURE = "images/results_length.svg"
CLAIMS = HERE / "claims.yaml"
EARLIER = "earlier_verdicts.csv"  # on rows 1 to 8, of runs that are no longer stored
DISTILLED = "distillation.csv"  # students of examples/distillation.py
_DISTILLED_CONTRASTS = (
    ("ego+obj", "raw"), ("ego+obj", "seg2"), ("ego+obj+seg2", "seg2"), ("ego+obj+seg2", "ego+obj"),
)  # fmt: skip
# Success [R, 3] at low, normal and high speed, by what runs learn from, people's speeds in training
# and stack.
Learned = Mapping[tuple[str, str, str], Array]
_COLOURS = ("#999999", "#56b4e9", "#0072b2", "#009e73", "#d55e00", "#cc79a7")
_BOUNDS = ("effect", "low", "high")
_ROW_OF_SIDES = {("ego+obj", "raw"): 6, ("ego+obj+seg2", "seg2"): 7, ("ego+obj+seg2", "ego+obj"): 8}
_STUDY = {"resolution": ", 84 px", "wide_confirmation": ", 0.6–2.4 m/s"}  # in the figure
_TIED = "\u00a0"  # a space at which no line breaks
_POWER = 0.8
_FOUND = 0.5  # a run finds a way if it succeeds in this share of its episodes
_HARDLY_EVER = 0.05  # success at the training speed


class Answer(NamedTuple):
    """What a study says about a claim."""

    difference: Estimate
    verdict: str
    note: str = ""  # people's speeds in training, if the column has several


Answers = Mapping[int, Sequence[Answer]]
"""Of one study, by the claim's row."""


def _as_trained(run: Run) -> Condition:
    return Condition("greedy", run.speed, run.fps)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"|{'|'.join(cells)}|" for cells in lines)


def share(value: float) -> str:
    """Returns a share with two digits, "" if it is unknown."""
    return "" if np.isnan(value) else f"{value:.2f}"


def claims_table(claims: Sequence[Claim], detectable: Sequence[float] | None = None) -> str:
    """Returns the table of claims in Markdown, a line for each contrast within a cell.

    Primary claims, whose p values are corrected, have the effects that would be detected.
    """
    rows = []
    for claim in claims:
        effects = "<br>".join(map(effect_text, claim.contrasts))
        by_scene = "<br>".join(
            ", ".join(f"{SHORT[scene]}{_TIED}{signed(e.value)}" for scene, e in c.by_scene.items())
            for c in claim.contrasts
        )
        text = f"{claim.text}<br>*{claim.limits}*" if claim.limits else claim.text
        higher = "<br>".join(share(contrast.higher) for contrast in claim.contrasts)
        row = (str(claim.number), text, f"**{claim.verdict}**", effects, higher, by_scene)
        rows.append(row if detectable is None else (*row, f"{detectable[len(rows)]:.0f}"))
    header = ("", "claim, *what limits it*", "verdict")
    if detectable is None:
        header += ("effect [95 %], p (uncorrected)", "P(higher)", "by scene")
    else:
        header += ("effect [95 %], p (Holm)", "P(higher)", "by scene", "detectable")
    return _table(header, rows)


def held_out_table(found: Sequence[HeldOut]) -> str:
    """Returns the table of claims on held-out speeds, with columns for collapsed runs if any."""
    rows, some_collapsed = [], any(number for each in found for number in each.collapsed)
    for claim, permuted, collapsed, without in found:
        (contrast,) = claim.contrasts
        by_cell = (f"{name} {signed(e.value)}" for name, e in contrast.by_scene.items())
        sides = " − ".join(_stack(contrast.asked[side]) for side in ("first", "second"))
        left_out = points(without.effect.interval()) if any(collapsed) and without.effect else ""
        number, text = f"H{claim.number}", f"{claim.text}: {sides}"
        tested = f"**{claim.verdict}**", effect_text(contrast), p_text(permuted)
        cells = ", ".join(cell.replace(" ", _TIED) for cell in by_cell)
        rows.append((number, text, *tested, cells))
        if some_collapsed:
            rows[-1] += (" and ".join(map(str, collapsed)), left_out)
    header = ("", "claim", "verdict", "effect [95 %], p (Holm)", "p by permutation")
    header += ("by split and scene", *(("collapsed", "without these") if some_collapsed else ()))
    return _table(header, rows)


def sensitivity_table(found: Mapping[int, Mapping[str, Contrast]]) -> str:
    """Returns the claims on held-out speeds in other ways, uncorrected."""
    rows = []
    for number, of in found.items():
        (seed, panel, *others), effects = of, map(effect_text, of.values())
        rows.append(
            (f"H{number}", f"{seed}: {next(effects)}", f"{panel}: {next(effects)}", *effects)
        )
    return _table(("", "without seed", "without panel", *others), rows)


def beside_table(found: Sequence[Mapping[str, Contrast]]) -> str:
    """Returns the secondary contrasts of the claims on held-out speeds."""
    rows = [(f"H{number}", *map(_points, of.values())) for number, of in enumerate(found, start=1)]
    return _table(("", *found[0]), rows)


def _points(contrast: Contrast) -> str:
    return points(contrast.effect.interval()) if contrast.effect else ""


def cell_table(cell: Cell) -> str:
    """Returns success in one split and scene, by stack, at all speeds that it was tested at."""
    first = cell.runs[0]
    modes = (cell.mode, first.speed, *({*SPEEDS} - {cell.mode, first.speed}))
    names = ("held out", "as in training", "the paper's training")
    header = ["", *(f"{n}, {_speed_range(first, m)}" for n, m in zip(names, modes))]
    conditions, rows = conditions_of(first, modes), []
    for stack, runs in in_stacks(cell.runs).items():
        found = (cell_of(runs, condition) for condition in conditions)
        shares = [percent(each.score) if each else "" for each in found]
        rows.append([_stack(stack), *shares, _each_run(runs, cell.mode)])
    blind = [baseline_share(cell.runs, at._replace(policy="speed_blind")) for at in conditions]
    percents = ["" if share is None else f"{100 * share:.0f}" for share in blind]
    rows.append(["a planner blind to speed", *percents, ""])
    return _table([*header, "each run, held out"], rows)


def above_the_planner(cells: Sequence[Cell]) -> list[str]:
    """Returns in how many cells each stack is above the planner that is blind to speed."""
    counts = Counter[str]()
    for cell in cells:
        (condition,) = conditions_of(cell.runs[0], [cell.mode])
        blind = baseline_share(cell.runs, condition._replace(policy="speed_blind"))
        for stack, runs in in_stacks(cell.runs).items():
            found = cell_of(runs, condition)
            counts[stack] += bool(found and blind is not None and found.score.value > blind)
    return [f"{_stack(stack)} in {count}" for stack, count in counts.items()]


def draw_held_out(cells: Sequence[Cell]) -> Figure:
    """Returns success at the speeds of training and held out, a panel for each split and scene."""
    grids = []
    for cell in cells:
        first, stacks = cell.runs[0], in_stacks(cell.runs)
        conditions = conditions_of(first, (first.speed, cell.mode))
        grid = grid_of(first.scene, stacks, conditions, ["speed_blind"])
        shown = [c._replace(speed=name) for c, name in zip(conditions, ("as trained", "held out"))]
        to = dict(zip(conditions, shown))
        cells_shown, baselines_shown = (
            {(name, to[condition]): share for (name, condition), share in shares.items()}
            for shares in (grid.cells, grid.baselines)
        )
        grids.append(
            SuccessGrid(cell.title, grid.series, tuple(shown), cells_shown, baselines_shown)
        )
    return draw_bars(grids)


def length_table(scenes: Mapping[str, Sequence[Run]]) -> str:
    """Returns the success of agents that were trained for the paper's number of frames."""
    rows = [
        (SHORT[scene], _stack(stack), *_successes(of), _each_run(of), _precisions(of))
        for scene, runs in scenes.items()
        for stack, of in in_stacks(runs).items()
    ]
    return _table(("", "", *SPEEDS, "each run, as trained", "precision"), rows)


def length_contrasts(claims: Sequence[Claim], found: Mapping[int, Contrast]) -> str:
    """Returns the contrasts at the paper's number of frames, paired by seed."""
    rows = [
        (
            _label(claims[row - 1], contrast),
            f"**{_short(contrast.verdict)}**",
            effect_text(contrast),
        )
        for row, contrast in found.items()
    ]
    return _table(("row", "verdict", "effect [95 %], p (Holm, by family)"), rows)


def _precisions(runs: Sequence[Run]) -> str:
    names = sorted({name for run in runs for name in run.machine["precision"].split(" | ")})
    return " and ".join(names)


def draw_length(scenes: Mapping[str, Sequence[Run]]) -> Figure:
    """Returns success over frames, at the speed of training, a panel for each scene."""
    return draw_curves(
        [
            (scene, {stack: [*map(curve_of, of)] for stack, of in in_stacks(runs).items()})
            for scene, runs in scenes.items()
        ]
    )


def students(data: Path = DATA) -> Learned:
    """Returns the success of students, which learn from labels."""
    found: dict[tuple[str, str, str], list[list[float]]] = {}
    with (data / DISTILLED).open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            name = "labels", row["trained_at_mps"].replace("-", "–"), row["representations"]
            found.setdefault(name, []).append([float(row[speed]) for speed in SPEEDS])
    return {name: np.array(rates) for name, rates in found.items()}


def rewarded(runs: Sequence[Run], stacks: Iterable[str]) -> Learned:
    """Returns the success of runs that learned from rewards, of these stacks."""
    found = {}
    for stack in stacks:
        if of := [run for run in runs if run.stack == stack]:
            cells = [cell_of(of, condition) for condition in conditions_of(of[0], SPEEDS)]
            name = "rewards", _speed_range(of[0], of[0].speed), stack
            found[name] = np.stack([cell.rates for cell in cells if cell], -1)
    return found


def learned_table(rates: Learned) -> str:
    """Returns success in %, at each speed and in the mean over the three."""
    rows = []
    for (source, trained_at, stack), of in rates.items():
        mean = percent(mean_share([of.mean(1)]))
        each = (f"{100 * rate:.0f}" for rate in of.mean(0))
        rows.append((source, trained_at, _stack(stack), str(len(of)), *each, mean))
    header = ("learned from", "trained at, m/s", "", "runs", *SPEEDS, "mean of the three [95 %]")
    return _table(header, rows)


def learned_effects(rates: Learned) -> dict[tuple[str, str, str, str], Effect]:
    """Returns the differences between two stacks in the mean over the three speeds."""
    return {
        (*of, first, second): effect([(rates[*of, first].mean(1), rates[*of, second].mean(1))])
        for of in dict.fromkeys(name[:2] for name in rates)
        for first, second in _DISTILLED_CONTRASTS
        if (*of, first) in rates and (*of, second) in rates
    }


def learned_contrasts(rates: Learned) -> str:
    """Returns these differences, and those at each speed, in points."""
    rows = []
    for (*of, first, second), found in learned_effects(rates).items():
        each = rates[*of, first].mean(0) - rates[*of, second].mean(0)
        tested = points(found.interval()), p_text(found.p_value)
        rows.append((*of, f"{_stack(first)} − {_stack(second)}", *tested, *map(signed, each)))
    header = ("learned from", "trained at, m/s", "", "mean of the three [95 %]")
    return _table((*header, "p (uncorrected)", *SPEEDS), rows)


def spread(groups: Iterable[Array]) -> float:
    """Returns the standard deviation of runs `[R, 3]` of a group, in points, over all groups."""
    means = [rates.mean(1) for rates in groups]
    squares = sum(((of - of.mean()) ** 2).sum() for of in means)
    return 100 * float(squares / sum(len(of) - 1 for of in means)) ** 0.5


def protocols_table(narrow: Sequence[Claim], wide: Sequence[Claim], scene: str) -> str:
    """Returns the primary contrasts of one scene, trained at the paper's speeds and at more."""
    rows = [
        (
            _label(first, first.contrasts[0]),
            points(first.contrasts[0].by_scene[scene].interval()),
            effect_text(second.contrasts[0]),
            f"**{second.verdict}**",
        )
        for first, second in zip(narrow, wide)
    ]
    header = ("row", "1.2–1.8 m/s", "0.6–2.4 m/s, p (Holm)", "verdict on the latter")
    return _table(header, rows)


def effect_text(contrast: Contrast) -> str:
    """Returns an effect with its interval and p.

    If the claim is that two stacks are equal, p is that of a difference within the margin, or
    beyond it if the effect is.
    """
    if contrast.effect is None:
        return "runs are missing"
    if np.isnan(contrast.p_value):
        return f"{signed(contrast.effect.value)}, one run a side"
    p, of_what = contrast.p_value, ""
    if contrast.asked["expect"] == "equal":
        margin = contrast.asked["margin"]
        is_beyond = abs(contrast.effect.value) > margin
        of_what = f" ({'beyond' if is_beyond else 'within'} ±{100 * margin:.0f})"
        p = contrast.p_against if is_beyond else p
    text = p_text(p)
    sign = "" if text.startswith("<") else "= "
    # a line breaks between them only
    parts = points(contrast.effect.interval()), f"p {sign}{text}{of_what}"
    return ", ".join(part.replace(" ", _TIED) for part in parts)


def answers_table(rows: Sequence[Claim], answers: Mapping[str, Answers]) -> str:
    """Returns the paper's claims with the verdict of each study, and the difference in points."""

    def cell(found: Sequence[Answer]) -> str:
        return "<br>".join(
            f"**{verdict}** {points(value)}{f', {note}' if note else ''}"
            for value, verdict, note in found
        )

    cells = [[cell(of.get(row.number, ())) for of in answers.values()] for row in rows]
    named = [(str(row.number), row.text, *of) for row, of in zip(rows, cells)]
    return _table(("", "the paper's claim", *answers), named)


def answers_of(
    primary: Sequence[Claim],
    earlier: Mapping[int, Mapping[str, str]],
    later: Sequence[Claim],
    led: Mapping[tuple[str, str, str, str], Effect],
    held_out: Sequence[HeldOut],
    long: Mapping[int, Contrast],
) -> dict[str, Answers]:
    """Returns what each study says about the paper's claims, by claim."""

    def of(contrast: Contrast) -> list[Answer]:
        assert contrast.effect is not None
        return [Answer(contrast.effect.interval(), _short(contrast.verdict))]

    first = {
        row: [Answer(Estimate(*(float(it[x]) / 100 for x in _BOUNDS)), it["verdict"])]
        for row, it in earlier.items()
    }
    by_labels: dict[int, list[Answer]] = {}
    for (source, trained_at, *sides), found in led.items():
        if source == "labels" and tuple(sides) in _ROW_OF_SIDES:
            verdict = _short(verdict_on("more", found, found.p_value, found.p_value))
            answer = Answer(found.interval(), verdict, f"{trained_at} m/s")
            by_labels.setdefault(_ROW_OF_SIDES[sides[0], sides[1]], []).insert(0, answer)
    return {
        "recipe 1": first,
        "recipe 2": {claim.number: of(claim.contrasts[0]) for claim in primary},
        "recipe 3": {claim.number: of(claim.contrasts[0]) for claim in later},
        "labels": by_labels,
        "held-out": {n: of(each.claim.contrasts[0]) for n, each in zip((6, 7, 8), held_out)},
    } | ({"two million frames": {row: of(each) for row, each in long.items()}} if long else {})


def _short(verdict: str) -> str:
    return verdict.removesuffix(" with this recipe")


def draw_answers(rows: Sequence[Claim], answers: Mapping[str, Answers]) -> Figure:
    """Returns the forest plot: the difference of each claim, a colour for each study."""
    with styled(8.0):
        figure = Figure(figsize=(7.4, 0.5 * len(rows) + 1.0), layout="constrained")
        axes = figure.add_subplot()
        axes.axvline(0, color="#6b7480", linewidth=0.8)
        for study, ((name, of), colour) in enumerate(zip(answers.items(), _COLOURS)):
            axes.plot([], [], color=colour, marker="o", label=name)
            for at, row in enumerate(rows):
                for nth, (value, _, note) in enumerate(of.get(row.number, ())):
                    face = "white" if note.startswith("0.6") else colour  # not the paper's speeds
                    y = at + 0.13 * (study - 2) + 0.05 * nth
                    ends = 100 * value.low, 100 * value.high
                    axes.plot(ends, [y, y], color=colour, linewidth=1.2)
                    axes.plot(100 * value.value, y, "o", color=colour, mfc=face, markersize=4.0)
        axes.set_yticks(range(len(rows)), [_label(row, row.contrasts[0]) for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.grid(axis="x")
        axes.set_xlabel("points (95 % intervals)")
        figure.legend(loc="outside upper center", ncols=6)
    return figure


def _label(claim: Claim, contrast: Contrast) -> str:
    asked, kind = contrast.asked, measure_of(contrast.asked)
    sides = [asked[side] for side in ("first", "second") if side in asked]
    names = ["all stacks" if isinstance(x, list) else _stack(x).strip("`") for x in sides]
    what = {"out_of_bounds": "out of bounds", "kept": "share kept"}.get(kind, "")
    if not what:
        units = [f"{n} Hz" if isinstance(n, int) else n for n in asked[kind]]
        what = (" − " if min(asked[kind].values()) < 0 else " and ").join(units)
    study = _STUDY.get(asked.get("study", ""), "")
    return f"{claim.number}  {' − '.join(names)}, {what}{study}"


def without(left_out: Sequence[Run], declared: Mapping[str, Any], studies: Studies) -> list[str]:
    """Returns the rows whose effect changes without some runs of the main study."""
    rest = {s: [r for r in of if r not in left_out] for s, of in studies["main"].items()}
    before, after = (
        [claim for claims in claims_of(declared, {**studies, "main": of}) for claim in claims]
        for of in (studies["main"], rest)
    )
    return [
        f"{effect_text(new)} in row {claim.number}"
        for claim, other in zip(before, after)
        for old, new in zip(claim.contrasts, other.contrasts)
        if old.effect != new.effect and new.effect is not None
    ]


def scene_table(runs: Sequence[Run], is_fork: bool) -> str:
    """Returns success by stack and speed in one scene, and how many runs find all ways."""
    at = [f"{speed}, {_speed_range(runs[0], speed)}" for speed in SPEEDS]
    header = ["", *at, f"each run, {runs[0].speed}"]
    header += [f"find all {len(runs[0].config['scene']['paths'])} ways"] if is_fork else []
    rows = []
    for stack, members in in_stacks(runs).items():
        rows.append([_stack(stack), *_successes(members), _each_run(members)])
        if is_fork:
            rows[-1].append(all_ways_found(members))
    of_speeds = [Condition("never_turn", speed, runs[0].fps) for speed in SPEEDS]
    shares = [baseline_share(runs, condition) for condition in of_speeds]
    never = ["" if share is None else f"{100 * share:.0f}" for share in shares]
    if any(never):
        rows.append(["never turning", *never, *[""] * (len(header) - 4)])
    return _table(header, rows)


def all_ways_found(runs: Sequence[Run]) -> str:
    """Returns how many of the runs find all ways."""
    number = sum(min(map(_share, _ends_by_way(run))) >= _FOUND for run in runs)
    return f"{number} of {len(runs)}"


def missed_ways(runs: Iterable[Run]) -> list[str]:
    """Returns each stack's seeds that miss a way, and how each ends on its worst path."""
    missed: dict[str, list[str]] = {}
    for run in runs:
        worst = min(_ends_by_way(run), key=_share)
        if _share(worst) < _FOUND:
            end, _ = Counter(worst[worst != "success"].tolist()).most_common(1)[0]
            seeds = missed.setdefault(f"{_stack(run.stack)} in {SHORT[run.scene]}", [])
            seeds.append(f"{run.seed}: {100 * _share(worst):.0f} %, {words(end).lower()}")
    return [f"{name} ({'; '.join(seeds)})" for name, seeds in missed.items()]


def _ends_by_way(run: Run) -> list[Array]:
    """Returns how episodes end on each path, with greedy actions at the training speed."""
    driven = run.under(_as_trained(run))
    ends = np.where(driven["hit"] == "", driven["outcome"], driven["hit"])
    return [ends[driven["path"] == path["name"]] for path in run.config["scene"]["paths"]]


def _share(ends: Array) -> float:
    return success_rate([ends]) if len(ends) else 0.0


def _successes(runs: Sequence[Run]) -> list[str]:
    cells = [cell_of(runs, condition) for condition in conditions_of(runs[0], SPEEDS)]
    return [percent(cell.score) if cell else "" for cell in cells]


def _each_run(runs: Sequence[Run], speed: str = "") -> str:
    """Returns the runs' success, at their training speed by default."""
    cell = cell_of(runs, Condition("greedy", speed or runs[0].speed, runs[0].fps))
    return ", ".join(f"{100 * rate:.0f}" for rate in (cell.rates if cell else ()))


def _stack(stack: str) -> str:
    return f"`[{stack.replace('+', ',')}]`"


def failure_table(papers: Mapping[str, float], runs: Sequence[Run]) -> str:
    """Returns the paper's Table III beside ours, of low and high speed and of the training's."""
    rows, here = [], in_stacks(runs)
    for stack in (stack for stack in papers if stack in here):
        members, shares = here[stack], []
        for speeds in (("low", "high"), ("normal",)):
            of_runs = scores_of(members, conditions_of(members[0], speeds), departures)
            shares.append(percent(mean_share([of_runs])) if len(of_runs) else "")
        rows.append((_stack(stack), f"{papers[stack]:.1f}", *shares, str(len(members))))
    return _table(("", "the paper", "low and high", "training", "runs"), rows)


def rate_table(runs: Sequence[Run]) -> str:
    """Returns success by frame rate on the episodes driven at all of them, and what is kept."""
    frame_rates = sorted({c.fps for run in runs for c in run.conditions})
    rows = []
    for stack, members in in_stacks(runs).items():
        means = []
        for rate in frame_rates:
            # all rates are named, so that the episodes are those that were driven at each
            of_runs = scores([members], {"success": {int(r): r == rate for r in frame_rates}})
            means.append(float(of_runs[0].mean()) if of_runs else float("nan"))
        cells = [f"{100 * mean:.0f}" for mean in means]
        lost = signed(means[0] - means[-1])
        rows.append((_stack(stack), *cells, lost, f"{means[0] / means[-1]:.2f}", str(len(members))))
    first, last = f"{frame_rates[-1]:g}", f"{frame_rates[0]:g}"
    header = ("", *(f"{r:g} Hz" for r in frame_rates), f"{first} → {last}, points", "kept", "runs")
    return _table(header, rows)


def variation_table(titles: Mapping[str, str], studies: Studies) -> str:
    """Returns the success of each stack in further studies, with the speeds of training."""

    def row(title: str, scene: str, stack: str, runs: Sequence[Run]) -> Sequence[str]:
        trained_at = _speed_range(runs[0], runs[0].speed)
        return (title, SHORT[scene], _stack(stack), trained_at, *_successes(runs), str(len(runs)))

    rows = [
        row(title, scene, stack, runs)
        for study, title in titles.items()
        for scene, members in studies[study].items()
        for stack, runs in in_stacks(members).items()
    ]
    at = ("low, 0.6–1.0", "as trained", "high, 2.0–2.4")
    return _table(("", "", "", "trained at, m/s", *at, "runs"), rows)


def _speed_range(run: Run, speed: str) -> str:
    return "–".join(map(str, run.config["scene"]["pedestrian_speed_mps"][speed]))


def estimates_table(titles: Mapping[str, str], studies: Studies) -> str:
    """Returns success at the training speed, scene beside scene, for each kind of estimates."""
    scenes = list(dict.fromkeys(scene for study in titles for scene in studies[study]))
    rows = []
    for study, title in titles.items():
        of_scenes = [in_stacks(studies[study].get(scene, [])) for scene in scenes]
        for stack in in_order([stack for of in of_scenes for stack in of], STACKS):
            cells: list[str] = []
            for runs in (of.get(stack, []) for of in of_scenes):
                cells += [_successes(runs)[1], _each_run(runs)] if runs else ["", ""]
            rows.append((title, _stack(stack), *cells))
    header = [x for scene in scenes for x in (words(scene), "each run")]
    return _table(("", "", *header), rows)


def runs_table(studies: Studies) -> str:
    """Returns the number of runs of each stack in each study and scene."""
    columns = {
        f"{'' if study == 'main' else study.replace('_', ' ')} {SHORT[scene]}".strip(): members
        for study, scenes in studies.items()
        for scene, members in scenes.items()
    }
    stacks = in_order([run.stack for members in columns.values() for run in members], STACKS)
    counts = [[sum(r.stack == stack for r in of) for of in columns.values()] for stack in stacks]
    rows = [(_stack(s), *(str(n or "") for n in of)) for s, of in zip(stacks, counts)]
    return _table(("", *columns), rows)


def smallest_differences(claims: Sequence[Claim]) -> list[float]:
    """Returns the true difference that each contrast detects with a power of 80 %, in points.

    The level is the one that Holm's method demands of the smallest p: 5 % over their number. It is
    nan for a contrast that can't be tested.
    """
    effects = [x.effect for claim in claims for x in claim.contrasts]
    errors = [(e.error, stats.t(e.freedom)) if e else (np.nan, stats.t(1)) for e in effects]
    level = LEVEL / max(sum(not np.isnan(error) for error, _ in errors), 1)
    return [100 * error * float(t.ppf(1 - level / 2) + t.ppf(_POWER)) for error, t in errors]


def of_bfloat16(runs: Sequence[Run]) -> tuple[int, Array]:
    """Returns how many runs computed in bfloat16, and how much better they are than the others.

    The latter is in points, in the mean over speeds, for each scene and stack with both kinds.
    """
    asked, differences = {"success": dict.fromkeys(SPEEDS, 1 / 3)}, []
    cells: dict[Any, tuple[list[Run], list[Run]]] = {}
    for run in runs:
        is_other = run.machine.get("precision") != "bfloat16"
        cells.setdefault((run.scene, run.stack), ([], []))[is_other].append(run)
    for sides in cells.values():
        if rates := scores(sides, asked):
            differences.append(100 * (rates[0].mean() - rates[1].mean()))
    return sum(len(short) for short, _ in cells.values()), np.array(differences)


def sampled_minus_greedy(runs: Sequence[Run]) -> list[list[float]]:
    """Returns how much better sampled actions are, in points, by run and speed.

    Runs that were evaluated with only one kind of actions are left out.
    """
    by_run = []
    for run in runs:
        differences = []
        for speed in SPEEDS:
            conditions = (Condition(policy, speed, run.fps) for policy in ("sampled", "greedy"))
            sampled, greedy = (run.under(c)["outcome"] for c in conditions)
            if len(sampled) and len(greedy):
                differences.append(100 * (success_rate([sampled]) - success_rate([greedy])))
        by_run += [differences] if differences else []
    return by_run


def render(declared: Mapping[str, Any], runs: Sequence[Run]) -> tuple[str, dict[str, Figure]]:
    """Returns the page and its figures by file."""
    studies = studies_of(declared, runs)
    primary, secondary = claims_of(declared, studies)
    main, forks = studies["main"], declared["forks"]

    def in_its_scenes(study: str) -> list[Claim]:
        return claims_of({**declared, "scenes": [*studies[study]]}, studies, study)[0]

    def beside(study: str, second: str, weights: Mapping[Any, int], *scenes: str) -> Contrast:
        asked = {"first": "ego+obj", "second": second, "expect": "more", "success": weights}
        return contrast_of(asked, studies[study], scenes or [*studies[study]])

    every = [run for of in main.values() for run in of]
    asked = [contrast.asked for claim in primary for contrast in claim.contrasts]
    stacks = {each.get(side) for each in asked for side in ("first", "second")}
    decisive = [r for r in every if r.scene in declared["scenes"] and r.stack in stacks]
    failed = [r for r in every if _share(r.under(_as_trained(r))["outcome"]) < _HARDLY_EVER]
    with (DATA / EARLIER).open(encoding="utf-8", newline="") as file:
        earlier = {int(row["row"]): row for row in csv.DictReader(file)}
    cells = held_out_cells(declared, studies)
    by_labels = students()
    stacks_with_labels = dict.fromkeys(stack for _, _, stack in by_labels)
    by_rewards = rewarded(studies["laptop"].get("straight_road", []), stacks_with_labels)
    learned = {**by_labels, **by_rewards}
    led = learned_effects(learned)
    held_out, others = held_out_claims(declared, cells), beside_held_out(declared, cells)
    later, long = in_its_scenes("laptop"), at_length(declared, studies)
    answers = answers_of(primary, earlier, later, led, held_out, long)
    figures = {FIGURE: draw_answers(primary, answers), HELD_OUT_FIGURE: draw_held_out(cells)}
    at_that_length = studies[declared["at_length"]["study"]]
    if at_that_length:
        figures[LENGTH_FIGURE] = draw_length(at_that_length)
    in_other_ways = {
        n: sensitivity(each.claim.contrasts[0].asked, cells) for n, each in enumerate(held_out, 1)
    }
    detectable = smallest_differences(primary)
    text = (
        TEMPLATES.overlay(loader=FileSystemLoader(HERE))
        .get_template("results.md.jinja")
        .render(
            primary=claims_table(primary, detectable),
            secondary=claims_table(secondary),
            detectable=detectable,
            decisive=len(decisive),
            answers=answers_table(primary, answers),
            sensitivity=sensitivity_table(in_other_ways),
            undated=[study.replace("_", " ") for study in undated(declared, studies)],
            later_scenes=[words(scene) for scene in studies["laptop"]],
            held_out=held_out_table(held_out),
            effects=[_points(each.claim.contrasts[0]) for each in held_out],
            any_collapsed=any(number for each in held_out for number in each.collapsed),
            beside=beside_table(others),
            others=[{name: _points(c) for name, c in of.items()} for of in others],
            above=above_the_planner(cells),
            held_out_seeds=sorted({run.seed for cell in cells for run in cell.runs}),
            cells={cell.title: cell_table(cell) for cell in cells},
            held_out_figure=HELD_OUT_FIGURE,
            # row 14 against the paper's other stack of two frames, row 19 at each speed alone
            against_depth=effect_text(beside("frame_rate", "depth2", {12: 1, 6: -1})),
            alone={
                speed: effect_text(beside("wide_confirmation", "raw", {speed: 1}))
                for speed in SPEEDS
            },
            learned=learned_table(learned),
            learned_contrasts=learned_contrasts(learned),
            lead=[
                points(led[names].interval())
                for names in (
                    ("labels", "1.2–1.8", "ego+obj", "raw"),
                    ("rewards", "1.2–1.8", "ego+obj", "raw"),
                    ("labels", "0.6–2.4", "ego+obj", "raw"),
                    ("labels", "0.6–2.4", "ego+obj+seg2", "seg2"),
                    ("labels", "0.6–2.4", "ego+obj+seg2", "ego+obj"),
                )
            ],
            spreads=[spread(of.values()) for of in (by_labels, by_rewards)],
            wide=protocols_table(primary, in_its_scenes("wide_speeds"), "straight_road"),
            figure=FIGURE,
            length_figure=LENGTH_FIGURE,
            length_decides=bool(long),
            early=_points(beside("laptop", "raw", {"normal": 1}, "straight_road")),
            at_length={row: _points(contrast) for row, contrast in long.items()},
            length_seeds=min(
                (int(c.effect.freedom) + 1 for c in long.values() if c.effect), default=0
            ),
            length=length_table(at_that_length) if at_that_length else "",
            length_contrasts=length_contrasts([*primary, *secondary], long),
            length_held_out={
                cell.title: cell_table(cell)
                for cell in held_out_cells({"held_out": declared["at_length"]}, studies)
            },
            scenes={words(scene): scene_table(of, scene in forks) for scene, of in main.items()},
            missed=missed_ways(run for run in every if run.scene in forks),
            ways={s: all_ways_found([*chain(*studies[s].values())]) for s in declared["ways"]},
            failures=failure_table(declared["table_iii"], main.get("s_turn", [])),
            frame_rates={
                words(scene): rate_table(of) for scene, of in studies["frame_rate"].items()
            },
            variations=variation_table(declared["variations"], studies),
            estimates=estimates_table(declared["estimates"], studies),
            runs=runs_table({s: of for s, of in studies.items() if s not in declared["estimates"]}),
            commands={study: c for study, c in declared["commands"].items() if studies[study]},
            number=len(runs),
            failed=[f"{_stack(r.stack)} in {SHORT[r.scene]} (seed {r.seed})" for r in failed],
            without=without(failed, declared, studies),
            episodes=sum(len(run.episodes["outcome"]) for run in runs),
            sampled=sampled_minus_greedy(every),
            short=of_bfloat16(every),
            main_runs=len(every),
            np=np,
        )
    )
    return text, figures


def main(data: Path = DATA, page: Path = PAGE) -> None:
    """Entry point."""
    declared = yaml.safe_load(CLAIMS.read_text(encoding="utf-8"))
    text, figures = render(declared, read_archives(data))
    page.write_text(text, encoding="utf-8")
    for name, figure in figures.items():
        (page.parent / name).write_bytes(encoded(figure, "svg"))
    print(f"{page}: {len(text.split()):,} words")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
