"""Assembles the sections of a report from runs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice, product
from string import ascii_uppercase

from flowrep.config.command_line import folder_name
from flowrep.report.comparing import Settings, experiment_section, scenes_of, success_section
from flowrep.report.experiments import (
    COMPLEMENTARY,
    FLOW_COMPOSITION,
    STACKS,
    VARIATIONS,
    Variation,
)
from flowrep.report.failing import failure_section
from flowrep.report.families import Family, families_of
from flowrep.report.learning import curve_panels, draw_curves
from flowrep.report.rates import has_rates, rate_section
from flowrep.report.results import by_stack, in_order
from flowrep.report.runs import Run
from flowrep.report.sections import Drawing, Section
from flowrep.report.tables import Table


@dataclass(frozen=True)
class Chapter:
    """The sections of comparable runs; `label` says what distinguishes them from other runs."""

    label: str
    runs: tuple[Run, ...]
    sections: tuple[Section, ...]


@dataclass(frozen=True)
class Report:
    """Everything that a page shows of runs, except pictures of their drives."""

    runs: tuple[Run, ...]
    complaints: tuple[str, ...]
    chapters: tuple[Chapter, ...]


def assemble(runs: Sequence[Run], complaints: Sequence[str], ask: Settings) -> Report:
    """Returns the sections for runs, family by family, and the problems found in runs."""
    families = families_of(runs)
    wrong = [*complaints, *(w for w in (_unusable(run, ask) for run in runs) if w)]
    chapters = []
    for number, family in enumerate(families):
        sections = family_sections(family, ask)
        if len(families) > 1:
            sections = [replace(s, name=f"{number + 1}_{s.name}") for s in sections]
        chapters.append(Chapter(family.label, family.runs, tuple(sections)))
    if len(families) > 1:
        chapters.append(Chapter("", tuple(runs), tuple(across(families, ask))))
    return Report(tuple(runs), tuple(wrong), tuple(c for c in chapters if c.sections))


def _unusable(run: Run, ask: Settings) -> str | None:
    """Returns why a run fills no cell, None if it does."""
    if not run.is_finished:
        return (
            f"{run.path} is not finished, at {run.frames:,} of {run.total_frames:,} frames: only "
            "its learning curve is used"
        )
    if not any(condition.policy == ask.policy for condition in run.by_condition):
        return (
            f"{run.path} has no {ask.policy} evaluation at its end: only its learning curve is "
            f"used; python -m flowrep.evaluate run={run.path} policy={ask.policy} adds one"
        )
    return None


def family_sections(family: Family, ask: Settings) -> list[Section]:
    """Returns the sections of runs whose configs agree."""
    runs = [run for run in family.runs if _unusable(run, ask) is None]
    sections = []
    shown: set[str] = set()
    if runs:
        for experiment in (FLOW_COMPOSITION, COMPLEMENTARY):
            if experiment.is_in(family.runs) and any(r.stack in experiment.stacks for r in runs):
                sections.append(experiment_section(experiment, runs, ask))
                shown |= set(experiment.stacks)
        stacks = in_order([run.stack for run in runs], STACKS)
        if set(stacks) - shown:
            series = by_stack(runs, stacks)
            sections.append(success_section("success", "Success", series, None, ask))
        sections.append(failure_section(runs, ask))
        if has_rates(runs, ask):
            sections.append(rate_section(runs, ask))
    return [*sections, *_curves(family.runs)]


def _curves(runs: Sequence[Run]) -> list[Section]:
    stacks = in_order([run.stack for run in runs], STACKS)
    panels = curve_panels(by_stack(runs, stacks), scenes_of(runs))
    if not panels:
        return []
    caption = (
        "Learning curves. Bold, with markers: greedy evaluations at the training speed, the "
        "interquartile mean over seeds. Thin: each seed's training episodes, sampled actions."
    )
    drawing = Drawing("learning_curves", caption, tuple(panels), draw_curves)
    return [Section("learning_curves", "Learning curves", drawings=(drawing,))]


def across(families: Sequence[Family], ask: Settings) -> list[Section]:
    """Returns the results of stacks in families whose configs differ, side by side, not pooled."""
    told = [section for v in VARIATIONS if (section := variation_section(v, families, ask))]
    table = Section("configs", "Configs that differ", tables=(differing_keys(families),))
    if told:
        return [table, *told]
    sections = []
    in_all = [{run.stack for run in family.runs} for family in families]
    for stack in in_order([s for stacks in in_all for s in stacks], STACKS):
        series: dict[str, list[Run]] = {}
        taken: set[Run] = set()
        for letters, family in zip(_letters(len(families)), families):
            ours = [r for r in family.runs if r.stack == stack and _unusable(r, ask) is None]
            if ours and not taken & set(ours):
                series[letters] = ours
                taken |= set(ours)
        if len(series) > 1:
            named = folder_name(f"across_{stack}")
            sections.append(
                success_section(
                    named, f"{stack} under configs that differ", series, None, ask, baselines=()
                )
            )
    if not sections:
        return []
    return [table, *sections]


def variation_section(
    variation: Variation, families: Sequence[Family], ask: Settings
) -> Section | None:
    """Returns stacks side by side under configs that differ in one part; None if they aren't.

    Also returns None if a variant has more than one family, since they would be pooled.
    """
    if not variation.is_in(key for family in families for key in family.differences):
        return None
    by_variant = {variation.variant_of(family.runs[0]): family for family in families}
    if len(by_variant) < len(families):
        return None
    usable = {
        variant: [run for run in by_variant[variant].runs if _unusable(run, ask) is None]
        for variant in in_order(list(by_variant), variation.variants)
    }
    first, *others = usable
    found = [run.stack for runs in usable.values() for run in runs]
    stacks = in_order(found, variation.stacks)
    if not found or not others:
        return None
    series = {
        f"{stack}, {variant}": [run for run in runs if run.stack == stack]
        for stack in stacks
        for variant, runs in usable.items()
    }
    pairs = [(f"{stack}, {v}", f"{stack}, {first}") for stack in stacks for v in others]
    pairs += [(f"{stacks[0]}, {v}", f"{stack}, {v}") for v in usable for stack in stacks[1:]]
    section = success_section(variation.name, variation.title, series, pairs, ask, baselines=())
    notes = tuple(f"{variant}: {by_variant[variant].label}." for variant in usable)
    return replace(section, notes=(*notes, *section.notes))


def differing_keys(families: Sequence[Family]) -> Table:
    """Returns a table of the keys in which families differ, with a column per family."""
    keys = list(dict.fromkeys(key for family in families for key in family.differences))
    rows = tuple((key, *(f.differences.get(key, "") for f in families)) for key in keys)
    caption = "Keys of the configs in which the runs differ. No number is of runs of two columns."
    header = ("key", *_letters(len(families)))
    columns = tuple(range(1, len(families) + 1))
    return Table("configs", caption, header, (("", rows),), words=columns)


def _letters(number: int) -> list[str]:
    """Returns that many names: A to Z, AA, AB and so on."""
    texts = (map("".join, product(ascii_uppercase, repeat=length)) for length in count(1))
    return list(islice(chain.from_iterable(texts), number))
