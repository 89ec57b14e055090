"""Reads run folders: configs, episodes and metrics, and a list of what can't be read."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, get_args

from flowrep.experiment.evaluation import OUTCOMES
from flowrep.experiment.run import RunFolder, RunFolderError, origin_of
from flowrep.scenes.scene import SpeedMode
from flowrep.tables import TableError

_ORDER = ("raw", "ego", "obj", "seg", "seg2", "depth", "depth2", "rgb")
Rows = list[dict[str, str]]

SPEEDS: tuple[str, ...] = get_args(SpeedMode)
"""Pedestrians' speed modes, in the order of figures."""


class Condition(NamedTuple):
    """How agents were evaluated: policy, pedestrians' speed mode, frames per second."""

    policy: str
    speed: str
    fps: float


@dataclass(frozen=True, eq=False)
class Run:
    """The content of a run folder.

    Args:
        path: the folder.
        config: its config.yaml.
        episodes: rows of evaluation.csv.
        metrics: rows of metrics.csv.
    """

    path: Path
    config: Mapping[str, Any]
    episodes: Rows
    metrics: Rows

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The settings that determine its weights, by dotted key, without the seed.

        Keys that are specific to a scene are under the scene's name, and options of a
        representation under its name, so that two runs differ in them only if both have them.
        """
        parts = origin_of(self.config)
        del parts["flowrep"], parts["seed"]
        scene = parts.pop("scene")
        own = {key: value for key, value in scene.items() if key not in _OF_EVERY_SCENE}
        shared = {f"scene.{key}": scene[key] for key in _OF_EVERY_SCENE if key in scene}
        return dict([*_flat(parts | shared), *_flat(own, f"scene.{self.scene}")])

    def part_with(self, key: str) -> Any:
        """Returns what decides whether its identity may have a key, None if it can't."""
        place, _, rest = key.partition(".")
        if place == "representations":
            return next((n for n in self.config[place] if f"{rest}.".startswith(f"{n}.")), None)
        if place == "scene":
            parts = (*_OF_EVERY_SCENE, self.scene)
            return next((part for part in parts if f"{rest}.".startswith(f"{part}.")), None)
        deciding = {"algorithm": "_target_", "flow": "source"}.get(place)
        return (place, self.identity.get(f"{place}.{deciding}") if deciding else None)

    @property
    def scene(self) -> str:
        """The name of the scene that it was trained in."""
        return self.config["scene"]["name"]

    @property
    def stack(self) -> str:
        """What the agent sees, e.g. `ego+obj`, in a fixed order."""
        return stack_of(self.config["representations"])

    @property
    def seed(self) -> int:
        """The seed of the training."""
        return self.config["seed"]

    @property
    def speed(self) -> Any:
        """The pedestrians' speed mode in training."""
        return self.config["speed"]

    @property
    def fps(self) -> float:
        """The frame rate in training, in Hz."""
        return float(self.config["scene"]["frame_rate_hz"])

    @property
    def total_frames(self) -> int:
        """The frames that it should be trained for."""
        return self.config["total_frames"]

    @property
    def frames(self) -> int:
        """The frames that it has been trained for, from its tables."""
        return max((int(row["frames"]) for row in (*self.metrics, *self.episodes)), default=0)

    @property
    def is_finished(self) -> bool:
        """Returns whether it was trained for `total_frames`."""
        return self.frames >= self.total_frames

    @cached_property
    def tested(self) -> Rows:
        """Rows of the finished agent in its own scene, which no decision in training used."""
        return [
            row
            for row in self.episodes
            if row["evaluation"] != "training"
            and row["scene"] == self.scene
            and int(row["frames"]) >= self.total_frames
        ]

    @cached_property
    def by_condition(self) -> dict[Condition, Rows]:
        """The tested rows by condition."""
        rows: dict[Condition, Rows] = {}
        for row in self.tested:
            condition = Condition(row["policy"], row["speed"], float(row["fps"]))
            rows.setdefault(condition, []).append(row)
        return rows


_OF_EVERY_SCENE = ("camera", "frame_rate_hz")


def stack_of(representations: Iterable[str]) -> str:
    """Returns the name of a set of representations, in any order.

    >>> stack_of(["seg2", "obj", "ego"]), stack_of(["raw"])
    ('ego+obj+seg2', 'raw')
    """
    names = list(representations)
    known = [name for name in _ORDER if name in names]
    return "+".join([*known, *sorted(set(names) - set(known))])


def read_runs(folders: Iterable[Path]) -> tuple[list[Run], list[str]]:
    """Returns the runs in folders at any depth, and a line for each that was left out.

    Raises:
        RunFolderError: one of the folders holds no run at all.
    """
    runs: dict[Path, Run] = {}
    complaints: list[str] = []
    for folder in folders:
        configs = sorted(path for path in folder.rglob("config.yaml") if _is_of_a_run(path, folder))
        if not configs:
            what = (
                "holds no run: no config.yaml is in it or below"
                if folder.is_dir()
                else ("is a file" if folder.exists() else "does not exist")
            )
            raise RunFolderError(f"'{folder}' {what}. Give the folder of a run or of a sweep")
        for config in configs:
            if config.parent.resolve() in runs:
                continue
            try:
                runs[config.parent.resolve()] = _read(config.parent)
            except (RunFolderError, TableError, OSError, UnicodeDecodeError) as error:
                complaints.append(" ".join(str(error).split()))
    return _without_repeats(list(runs.values()), complaints), complaints


def _is_of_a_run(config: Path, folder: Path) -> bool:
    below = config.relative_to(folder).parts  # the folder itself may be called anything
    return ".hydra" not in below and "wandb" not in below


def _read(path: Path) -> Run:
    folder = RunFolder.existing(path)
    run = Run(path, folder.read_config(), folder.read_episodes(), folder.read_metrics())
    remedy = "restore the file that the run was started with"
    try:
        wrong = [f"{key} is {value!r}" for key, value, is_right in _parts(run) if not is_right]
    except KeyError as error:
        raise RunFolderError(f"{path}/config.yaml has no {error.args[0]}; {remedy}") from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise RunFolderError(
            f"{path}/config.yaml is not what a run leaves ({error}); {remedy}"
        ) from None
    if wrong:
        raise RunFolderError(f"{path}/config.yaml: {wrong[0]}; {remedy}")
    _check_cells(folder.metrics_path, run.metrics, {"success": lambda text: float(text or 0)})
    _check_cells(folder.evaluation_path, run.episodes, _CELLS)
    return run


def _parts(run: Run) -> list[tuple[str, Any, bool]]:
    """The parts of a config that a report reads, and whether a run can have left them."""
    assert run.identity
    json.dumps(run.config, default=str, ensure_ascii=False).encode()  # its texts can be written
    rate, names = run.config["scene"]["frame_rate_hz"], run.config["representations"]
    return [
        ("scene.name", run.scene, _is_name(run.scene)),
        ("scene.frame_rate_hz", rate, type(rate) in (float, int) and 0 < run.fps < math.inf),
        ("representations", names, type(names) is dict),
        *(("a name in representations", name, _is_name(name)) for name in names),
        ("seed", run.seed, type(run.seed) is int),
        ("speed", run.speed, run.speed in SPEEDS),
        ("total_frames", run.total_frames, type(run.total_frames) is int),
    ]


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable()


def _rate(text: str) -> float:
    if not 0 < float(text) < math.inf:
        raise ValueError(text)
    return float(text)


_CELLS: dict[str, Callable[[str], Any]] = {
    "fps": _rate,
    "speed": SPEEDS.index,
    "outcome": OUTCOMES[1:].index,
    "length": int,
}
"""The columns of evaluation.csv that a report reads beside those that every reader checks."""


def _check_cells(path: Path, rows: Rows, columns: Mapping[str, Callable[[str], Any]]) -> None:
    for number, row in enumerate(rows, start=2):
        for column, read in columns.items():
            try:
                read(row.get(column, ""))
            except ValueError:
                raise TableError(
                    f"{path}, line {number}: {column} can't be {row[column]!r}; correct or delete "
                    "the line"
                ) from None


def _without_repeats(runs: list[Run], complaints: list[str]) -> list[Run]:
    """Keeps one run per config and seed, since two would count as two seeds."""
    kept: dict[Any, Run] = {}
    for run in runs:
        key = (run.stack, run.seed, repr(sorted(run.identity.items(), key=lambda item: item[0])))
        other = kept.get(key)
        if other is None:
            kept[key] = run
            continue
        best = max(other, run, key=lambda r: (len(r.tested), r.frames))
        left = run if best is other else other
        complaints.append(
            f"{left.path} is the same run as {best.path}, config and seed: left out, it would "
            "count as another seed"
        )
        kept[key] = best
    return list(kept.values())


def _flat(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(inner, f"{place}.{key}" if place else str(key))
    else:
        yield place, _plain(value)


def _plain(value: Any) -> Any:
    """Returns a value that is spelt in one way: 4.0 in a file is 4 on a command line."""
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
