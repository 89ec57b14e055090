"""The runs behind the paper, a file per study: `outputs/reference/<study>.zip`.

    python -m paper.archive outputs/<sweep> ... --into outputs/reference/<study>.zip

A file is written once, so that a new study adds a file instead of changing one. It holds three
tables. `runs.jsonl` has a line per run: its name, machine and config. `episodes.csv` has a row per
evaluated episode, with the columns of `EpisodeRecord` that don't follow from config and outcome.
`training.csv` has a row per row of metrics.csv.
"""

import argparse
import csv
import io
import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from flowrep.experiment.run import RunFolderError
from flowrep.files import replace_bytes
from flowrep.report.runs import (
    EPISODE_COLUMNS,
    Cells,
    Columns,
    Run,
    episode_columns,
    metric_columns,
    read_runs,
)

_MACHINE = ("commit", "precision", "cpu")
MOST_BYTES = 1 << 30  # of the tables, which are read into memory
RUNS, EPISODES, TRAINING = "runs.jsonl", "episodes.csv", "training.csv"


def read_archives(folder: Path) -> list[Run]:
    """Returns the runs of all studies in a folder, by name."""
    runs = list(chain.from_iterable(map(read_archive, sorted(folder.glob("*.zip")))))
    _check_names(runs)
    return sorted(runs, key=lambda run: run.name)


def read_archive(path: Path) -> list[Run]:
    """Returns the runs of one study."""
    runs = []
    with ZipFile(path) as archive:
        if (size := sum(part.file_size for part in archive.infolist())) > MOST_BYTES:
            raise RunFolderError(f"'{path}' unpacks to {size:,} bytes, more than {MOST_BYTES:,}")
        episodes, training = (_cells_of_runs(archive, name) for name in (EPISODES, TRAINING))
        for line in archive.read(RUNS).decode("utf-8").splitlines():
            entry = json.loads(line)
            name, config = entry.pop("run"), entry.pop("config")
            columns = episode_columns(episodes.get(name, {}))
            metrics = metric_columns(training.get(name, {}))
            runs.append(Run(name, config, columns, metrics, machine=entry))
    return runs


def _cells_of_runs(archive: ZipFile, table: str) -> dict[str, Cells]:
    # Read by columns, because a dict for each of about 300,000 rows would take seconds.
    with archive.open(table) as file:
        lines = csv.reader(io.TextIOWrapper(file, encoding="utf-8", newline=""))
        names = next(lines)[1:]
        of_runs = groupby(lines, key=itemgetter(0))
        return {run: dict(zip(names, list(zip(*rows))[1:])) for run, rows in of_runs}


def write_archive(runs: Sequence[Run], path: Path) -> None:
    """Packs the runs of a study into a new file; the same runs give the same bytes."""
    if path.exists():
        raise RunFolderError(f"'{path}' is there, and a study is written once: name a new file")
    _check_names(runs)
    named = dict(sorted((Path(run.name).name, run) for run in runs))
    logged = list(dict.fromkeys(column for run in named.values() for column in run.metrics))
    lines = [
        json.dumps({"run": name, **machine_of(run), "config": run.config}, ensure_ascii=False)
        + "\n"
        for name, run in named.items()
    ]
    tables = {
        RUNS: "".join(lines),
        EPISODES: _packed([*EPISODE_COLUMNS], {n: run.episodes for n, run in named.items()}),
        TRAINING: _packed(logged, {name: run.metrics for name, run in named.items()}),
    }
    data = io.BytesIO()
    with ZipFile(data, "w", ZIP_DEFLATED) as archive:
        for name, text in tables.items():
            archive.writestr(ZipInfo(name), text.encode("utf-8"), ZIP_DEFLATED, 9)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bytes(path, data.getvalue())


def machine_of(run: Run) -> dict[str, str]:
    """Returns what machine.json says of a run: what trained it, and from when to when."""
    assert run.folder is not None
    path = run.folder / "machine.json"
    machines = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    # A run that was resumed on another machine has several.
    each = {key: dict.fromkeys(str(machine.get(key)) for machine in machines) for key in _MACHINE}
    ends = [("started", machines[0]), ("ended", machines[-1])] if machines else []
    times = {key: str(machine[key]) for key, machine in ends if machine.get(key)}
    return {key: " | ".join(names) or "unknown" for key, names in each.items()} | times


def _check_names(runs: Iterable[Run]) -> None:
    names = Counter(Path(run.name).name for run in runs)
    if repeated := [name for name, count in names.items() if count > 1]:
        raise RunFolderError(f"two runs are named {repeated[0]}: pack one of them, or rename it")


def _packed(names: Sequence[str], tables: Mapping[str, Columns]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("run", *names))
    for run, columns in tables.items():
        absent = np.full(max(map(len, columns.values()), default=0), np.nan)
        cells = [map(_text, columns.get(name, absent).tolist()) for name in names]
        writer.writerows((run, *row) for row in zip(*cells))
    return text.getvalue()


def _text(value: Any) -> str:
    if isinstance(value, float):  # five digits are enough for a loss
        return "" if math.isnan(value) else f"{value:.5g}" if abs(value) < 1e5 else f"{value:.0f}"
    return str(value)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Packs the runs of a study into one file.")
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs or of sweeps")
    parser.add_argument("--into", type=Path, required=True, help="the new file, <study>.zip")
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
