"""Reads runs from folders and from packed tables, and packs them.

    python -m flowrep.report.storage outputs/<sweep> ... --into outputs/reference

Packed runs are three tables. `runs.jsonl` has a line per run: its name, commit, precision, CPU and
config. `episodes.csv.gz` has a row per evaluated episode, with the columns of `EpisodeRecord` that
don't follow from config and outcome. `training.csv.gz` has a row per row of metrics.csv.
"""

import argparse
import csv
import gzip
import io
import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from fnmatch import fnmatch
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from flowrep.experiment.lock import RunFolderError
from flowrep.experiment.outcomes import EVALUATION_COLUMNS, OUTCOMES, EpisodeRecord
from flowrep.experiment.run import RunFolder
from flowrep.files import replace_files
from flowrep.report.runs import Columns, Run
from flowrep.tables import TableError

RUNS, EPISODES, TRAINING = "runs.jsonl", "episodes.csv.gz", "training.csv.gz"
Cells = Mapping[str, Sequence[str]]
_MACHINE = ("commit", "precision", "cpu")
_TYPES: dict[Any, type] = {"int": int, "float": float, "str": str}
_IMPLIED = ("representations", "flow", "seed", "return")
_EPISODES = {
    each.name: _TYPES[each.type]
    for each in fields(EpisodeRecord)
    if each.name in EVALUATION_COLUMNS and each.name not in _IMPLIED
}


def read_runs(folders: Iterable[Path]) -> tuple[list[Run], list[str]]:
    """Returns the runs in folders at any depth, and a warning for each that was left out.

    A folder of packed tables means all of its runs. With a pattern after its name, such as
    `outputs/reference/s_turn_*`, it means the runs whose names match.
    """
    runs: dict[str, Run] = {}  # by path, so that a folder given twice counts once
    warnings: list[str] = []
    for folder in folders:
        archive, pattern = (folder, "*") if folder.exists() else (folder.parent, folder.name)
        if is_archive(archive):
            packed = {run.name: run for run in read_archive(archive, pattern)}
            if not packed:
                raise RunFolderError(f"'{folder}': no packed run has a name like '{pattern}'")
            runs |= packed
            continue
        paths = [config.parent for config in sorted(folder.rglob("config.yaml"))]
        paths = [p for p in paths if {".hydra", "wandb"}.isdisjoint(p.relative_to(folder).parts)]
        if not paths:
            what = "holds no run" if folder.exists() else "does not exist"
            raise RunFolderError(f"'{folder}' {what}. Give the folder of a run or of a sweep")
        for path in paths:
            try:
                runs.setdefault(str(path.resolve()), read_run(path))
            except (RunFolderError, TableError, OSError, UnicodeDecodeError) as error:
                warnings.append(" ".join(str(error).split()))
    return list(runs.values()), warnings


def read_run(path: Path) -> Run:
    """Returns the run in a folder; raises RunFolderError or TableError for a damaged one."""
    folder = RunFolder.existing(path)
    try:
        config = folder.read_config()
        tables = folder.read_episodes(), folder.read_metrics()
        episodes, metrics = (
            {k: [row[k] for row in t] for k in (t[0] if t else ())} for t in tables
        )
        columns = episode_columns(episodes), _metric_columns(metrics)
        return Run(str(path), config, *columns, path, _machine(path / "machine.json"))
    except (RunFolderError, TableError):
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        what = f"config.yaml or a table is not what a run leaves ({error!r})"
        raise RunFolderError(f"{path}: {what}; restore the file that the run wrote") from None


def without_repeats(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Returns one run per config and seed, the one with the most tested episodes.

    The second value has a warning for each run that is left out.
    """
    kept: dict[Any, Run] = {}
    warnings = []
    for run in sorted(runs, key=lambda run: (-int(run.tested.sum()), -run.frames)):
        best = kept.setdefault((run.stack, run.seed, *sorted(run.settings.items())), run)
        if run is not best:
            same = f"{run.name} is the same run as {best.name}, config and seed"
            warnings.append(f"{same}: left out, as it would count as another seed")
    return [run for run in runs if run in kept.values()], warnings


def episode_columns(cells: Cells) -> Columns:
    """Returns the columns of evaluation.csv that a report reads, "" for missing ones."""
    empty = [""] * len(cells.get("frames", ()))
    columns: Columns = {
        name: np.array(cells.get(name, empty), kind) for name, kind in _EPISODES.items()
    }
    # A misspelt "success" would count as a failure.
    unknown = {*columns["outcome"].tolist()} - {*OUTCOMES}
    if unknown:
        names = ", ".join(map(repr, sorted(unknown)))
        raise ValueError(f"unknown outcome {names} of an episode; known: {', '.join(OUTCOMES)}")
    return columns


def _metric_columns(cells: Cells) -> Columns:
    return {name: np.array([float(x or "nan") for x in column]) for name, column in cells.items()}


def _machine(path: Path) -> dict[str, str]:
    # A run that was resumed on another machine has several machines.
    try:
        machines = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
        values = {key: dict.fromkeys(str(each.get(key)) for each in machines) for key in _MACHINE}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path.name}: {error}") from error
    return {key: " | ".join(names) or "unknown" for key, names in values.items()}


def is_archive(folder: Path) -> bool:
    """Returns whether a folder holds packed runs."""
    return (folder / RUNS).is_file()


def read_archive(folder: Path, pattern: str = "*") -> list[Run]:
    """Returns the packed runs of a folder whose names match a pattern."""
    runs, what = [], f"'{folder}'"
    try:
        episodes, training = _of_runs(folder / EPISODES), _of_runs(folder / TRAINING)
        for line in (folder / RUNS).read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            name = entry["run"]
            if fnmatch(name, pattern):
                what = f"'{folder}', run {name}"
                columns = episode_columns(episodes.get(name, {}))
                metrics = _metric_columns(training.get(name, {}))
                machine = {key: entry[key] for key in _MACHINE}
                runs.append(Run(name, entry["config"], columns, metrics, machine=machine))
    except Exception as error:  # gzip, csv and json fail on garbage in a dozen ways
        problem = f"damaged packed runs ({type(error).__name__}: {error}): restore them"
        raise RunFolderError(f"{what}: {problem}") from error
    return runs


def _of_runs(path: Path) -> dict[str, Cells]:
    # Read by columns, because a dict for each of about 400,000 rows would take seconds.
    with gzip.open(path, "rt", encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        names = next(lines)[1:]
        of_runs = groupby(lines, key=itemgetter(0))
        return {run: dict(zip(names, list(zip(*rows))[1:])) for run, rows in of_runs}


def write_archive(runs: Sequence[Run], folder: Path) -> None:
    """Adds runs to a folder of packed runs, and replaces those with the same names.

    The same runs give the same bytes.
    """
    names = Counter(Path(run.name).name for run in runs)
    if repeated := [name for name, count in names.items() if count > 1]:
        raise RunFolderError(f"two runs are named {repeated[0]}: pack one of them, or rename it")
    folder.mkdir(parents=True, exist_ok=True)
    before = read_archive(folder) if is_archive(folder) else []
    kept = dict(sorted({Path(run.name).name: run for run in (*before, *runs)}.items()))
    logged = list(dict.fromkeys(name for run in kept.values() for name in run.metrics))
    episodes = _packed([*_EPISODES], {name: run.episodes for name, run in kept.items()})
    training = _packed(logged, {name: run.metrics for name, run in kept.items()})
    lines = []
    for name, run in kept.items():
        machine = {key: run.machine.get(key, "unknown") for key in _MACHINE}
        entry = {"run": name, **machine, "config": run.config}
        lines.append(json.dumps(entry, ensure_ascii=False) + "\n")
    files = {EPISODES: episodes, TRAINING: training, RUNS: "".join(lines).encode("utf-8")}
    replace_files(folder, files)


def _packed(names: Sequence[str], tables: Mapping[str, Columns]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("run", *names))
    for run, columns in tables.items():
        absent = np.full(max(map(len, columns.values()), default=0), np.nan)
        cells = [map(_text, columns.get(name, absent).tolist()) for name in names]
        writer.writerows((run, *row) for row in zip(*cells))
    return gzip.compress(text.getvalue().encode("utf-8"), mtime=0)


def _text(value: Any) -> str:
    if isinstance(value, float):  # five digits are enough for a loss
        return "" if math.isnan(value) else f"{value:.5g}" if abs(value) < 1e5 else f"{value:.0f}"
    return str(value)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Packs run folders into three tables.")
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs or of sweeps")
    parser.add_argument("--into", type=Path, required=True, help="the folder of the tables")
    asked = parser.parse_args()
    try:
        runs, warnings = read_runs(asked.folders)
        for warning in warnings:
            print(f"left out: {warning}")
        write_archive(runs, asked.into)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    print(f"{asked.into}: {len(runs)} runs packed")


if __name__ == "__main__":
    main()
