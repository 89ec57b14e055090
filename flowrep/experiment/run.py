"""A run's folder: its lock, config, tables of metrics and episodes, loggers and checkpoint."""

import errno
import fcntl
import json
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torchrl.record.loggers import TensorboardLogger

from flowrep import __version__
from flowrep.agent import CheckpointError
from flowrep.config import UsageError
from flowrep.config.schema import ALGORITHMS, EstimatedFlow, TrainConfig, validated_run
from flowrep.config.yaml_file import read_yaml
from flowrep.experiment.evaluation import OUTCOMES, failure_causes
from flowrep.extras import require
from flowrep.files import naming, replace_file, replace_text, set_aside
from flowrep.tables import append_rows, is_whole, read_rows, write_rows

Rows = Sequence[Mapping[str, str]]

EVALUATION_COLUMNS = (
    "scene", "scene_id", "representations", "flow", "seed", "frames", "evaluation",
    "policy", "speed", "fps", "episode_seed", "path", "outcome", "hit", "return", "length",
)  # fmt: skip
_EPISODE = ("scene", "scene_id", "frames", "evaluation", "policy", "speed", "fps", "episode_seed")
"""The columns that identify a row's policy and episode."""
_DRIVE = ("scene_id", "evaluation", "frames", "policy", "speed", "fps", "episode_seed", "outcome")
"""The columns in drives.npz."""
_CHECKS: dict[str, Callable[[str], Any]] = {
    "frames": int, "fps": float, "outcome": OUTCOMES[1:].index,
}  # fmt: skip
"""Of cells in evaluation.csv: an outcome that is none would count as a failure."""

_IDENTITY = (
    "scene", "representations", "flow", "motion", "noise", "algorithm", "speed", "seed", "num_envs",
)  # fmt: skip
"""The parts of a config that determine the weights after some number of frames."""


class RunFolderError(ValueError):
    """A folder is not that of a run, or holds a run where none is wanted."""


class FolderInUseError(OSError):
    """Another process works in the folder."""


class _Lock:
    """The file by which a process holds a folder, and in which it describes itself.

    The kernel's lock is on the open file and ends with the process, in whatever way. The file
    stays: if holders removed it, another could lock a new one of that name beside them.
    """

    _NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # raised by some network disks

    def __init__(self, folder: Path) -> None:
        self._path, self._text = folder / ".lock", b""
        # through no link, and not waiting for the other end of a named pipe
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            self._file = os.open(self._path, flags, 0o666)
            found = os.fstat(self._file)
            is_plain = stat.S_ISREG(found.st_mode) and found.st_nlink < 2
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            is_plain = False
        if not is_plain:
            raise RunFolderError(f"'{self._path}' is a link or no file; no run made it: remove it")

    def take(self, doing: str) -> bool:
        """Locks the file; returns False if another process holds it."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in self._NO_LOCKS:
                raise
            if platform.node() in self.holder():  # which is alive
                return False
            print(f"warning: no locks on the disk of '{self._path}' ({error})", file=sys.stderr)
        if not self._is_at_its_path():  # replaced since it was opened
            return False
        now = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        text = {"pid": os.getpid(), "host": platform.node(), "doing": doing, "since": now}
        text["note"] = "free once that process has ended; if this file is removed, two can run"
        self._text = json.dumps(text).encode()
        with naming(self._path):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, self._text, 0)
        return True

    def check(self) -> None:
        """Checks that no other process can have taken the folder since."""
        if not (self._is_at_its_path() and self._is_ours()):
            raise RunFolderError(
                f"'{self._path}' was removed or replaced, so another process can take the folder: "
                "this one stops, and has written nothing since. Leave that file alone during a run"
            )

    def holder(self) -> str:
        """Describes the process that wrote the file; empty if that has ended."""
        try:
            found = json.loads(os.pread(self._file, 4096, 0))
            pid, host = int(found["pid"]), found["host"]
            text = f"process {pid} on {host} has been {found['doing']} in it since {found['since']}"
        except (ValueError, KeyError, TypeError):  # nothing yet, or not its text
            return ""
        if host == platform.node() and not _is_alive(pid):
            return ""
        return "".join(filter(str.isprintable, text))

    def close(self) -> None:
        """Lets others take it."""
        if self._text and self._is_ours():
            os.ftruncate(self._file, 0)
        os.close(self._file)

    def _is_at_its_path(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._file), os.lstat(self._path))
        except FileNotFoundError:
            return False

    def _is_ours(self) -> bool:
        # on a disk without locks, another process may have written to the same file
        return os.pread(self._file, len(self._text) + 1, 0) == self._text


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # of another user
        pass
    return True


def origin_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the identity of a run: flowrep's version, and the config keys that define it."""
    whole = {"motion": "exact", **config}  # earlier runs have no motion
    parts = json.loads(json.dumps({key: whole[key] for key in _IDENTITY}))
    return {"flowrep": __version__} | _without_defaults(parts)


def _without_defaults(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Returns parts of a config without options at the schema's default."""
    # only options that earlier runs did not have yet have a default there
    of_algorithm = ALGORITHMS.get(parts["algorithm"]["_target_"])
    kept = dict(parts)
    for key, section in {"algorithm": of_algorithm, "flow": EstimatedFlow}.items():
        fields = section.model_fields if section else {}
        options = parts[key].items()
        kept[key] = {k: v for k, v in options if k not in fields or fields[k].default != v}
    # read by configs that choose images, and by no street
    kept["scene"] = {key: value for key, value in parts["scene"].items() if key != "symmetric"}
    return kept


def check_origin(saved: Mapping[str, Any], expected: Mapping[str, Any], path: Path) -> None:
    """Checks that a checkpoint belongs to a run; the error names the first difference."""
    if saved.get("flowrep") != expected["flowrep"]:
        raise CheckpointError(
            f"{path} was written by flowrep {saved.get('flowrep')}, this is {expected['flowrep']}: "
            "install that version, or start a new run"
        )
    there = _flat(_without_defaults({"motion": "exact", **saved}))
    here = _flat(expected)
    for key in {**there, **here}:
        was, now = there.get(key, "absent"), here.get(key, "absent")
        if was != now and key.partition(".")[0] in expected:
            raise CheckpointError(
                f"{path} belongs to a run with {key}={was}, the config.yaml of its folder says "
                f"{key}={now}: restore the file that was there, or start a new run"
            )


def _flat(config: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    """Returns nested values by their dotted keys; an empty mapping is a value."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        nested = _flat(value, f"{place}{key}.") if isinstance(value, Mapping) else {}
        flat |= nested or {f"{place}{key}": value}
    return flat


def machine_of(precision: torch.dtype) -> dict[str, Any]:
    """Returns what a run is computed with: versions, commit, processor and number format."""
    home, commit = Path(__file__).parents[2], None
    if (home / ".git").exists() and shutil.which("git"):
        ask = ["git", "-C", str(home), "describe", "--always", "--dirty", "--abbrev=40"]
        found = subprocess.run([*ask, "--exclude=*"], capture_output=True, text=True)
        commit = found.stdout.strip() or None
    return {
        "flowrep": __version__,
        "commit": commit,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "precision": str(precision).removeprefix("torch."),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def cpu_name() -> str:
    """Returns the processor's name."""
    info = Path("/proc/cpuinfo")  # of Linux, where platform.processor() is empty
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or platform.machine())


def _scalars(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Returns shares of outcomes, mean return and mean length of each kind of episode, by title."""
    values: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        kind = row["evaluation"].replace("training", "evaluation")  # training has scalars too
        rate = f"{float(row['fps']):g}fps"
        title = "/".join((kind, row["scene"], row["speed"], rate, row["policy"]))
        for name in OUTCOMES[1:]:
            values[f"{title}/{name}"].append(row["outcome"] == name)
        for name in ("return", "length"):
            values[f"{title}/{name}"].append(float(row[name]))
    return {title: fmean(found) for title, found in values.items()}


class RunFolder:
    """The files of one run, by name; docs/runs.md says what is in them."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_path = self.path / "config.yaml"
        self.metrics_path = self.path / "metrics.csv"
        self.checkpoint_path = self.path / "checkpoint" / "latest.safetensors"
        self.evaluation_path = self.path / "evaluation.csv"
        self.drives_path = self.path / "drives.npz"
        self.failures_path = self.path / "failures.csv"
        self.curve_path = self.path / "learning_curve.png"
        self._loggers: list[Any] = []
        self._lock: _Lock | None = None

    @classmethod
    def existing(cls, path: str | Path) -> "RunFolder":
        """Opens the folder of an existing run."""
        if not (Path(path) / "config.yaml").is_file():
            raise RunFolderError(
                f"'{path}' holds no run: it has no config.yaml. Give the folder that a training "
                "printed as its run folder"
            )
        return cls(path)

    @classmethod
    def all_in(cls, path: str | Path) -> list["RunFolder"]:
        """Opens a run's folder, or all run folders in a sweep's folder."""
        runs = sorted(config.parent for config in Path(path).glob("*/config.yaml"))
        is_sweep = runs and not (Path(path) / "config.yaml").is_file()
        return [cls(run) for run in runs] if is_sweep else [cls.existing(path)]

    def check_is_new(self) -> None:
        """Checks that a run can begin here."""
        files = (self.config_path, self.metrics_path, self.evaluation_path, self.checkpoint_path)
        found = [file for file in files if file.exists()]
        if found:
            is_run = found[0] == self.config_path
            how = f"continue it with resume={self.path}, or " if is_run else ""
            raise RunFolderError(
                f"'{self.path}' holds a run already ({found[0].name}): {how}give the new one a "
                "folder of its own with hydra.run.dir="
            )

    @contextmanager
    def held(self, doing: str, patience_s: float = 0.0) -> Iterator[None]:
        """Locks the folder against other processes, until the process ends in whatever way."""
        self.path.mkdir(parents=True, exist_ok=True)
        until = time.monotonic() + patience_s
        while True:
            with closing(_Lock(self.path)) as lock:
                if lock.take(doing):
                    self._lock = lock
                    try:
                        yield
                    finally:
                        self._lock = None
                    return
                if time.monotonic() >= until:
                    holder = lock.holder() or "another process has just begun in it"
                    raise FolderInUseError(
                        f"'{self.path}' is in use: {holder}. Wait until it has ended, or stop it"
                    )
            time.sleep(0.5)

    def check_held(self) -> None:
        """Checks that the folder, if this process has locked it, still is."""
        if self._lock is not None:
            self._lock.check()

    def _prepare(self) -> None:
        """Checks that the folder may be written to, and makes a new one."""
        self.check_held()
        self.path.mkdir(parents=True, exist_ok=True)

    def video_path(self, name: str) -> Path:
        """The file for a video of that name."""
        (self.path / "videos").mkdir(exist_ok=True)
        return self.path / "videos" / f"{name}.mp4"

    def write_config(self, config: Mapping[str, Any], overrides: Iterable[str] = ()) -> None:
        """Writes the resolved config, and the typed overrides where Hydra keeps them."""
        self._prepare()
        (self.path / ".hydra").mkdir(exist_ok=True)
        typed = yaml.safe_dump(list(overrides), allow_unicode=True)
        replace_text(self.path / ".hydra" / "overrides.yaml", typed)
        replace_text(self.config_path, yaml.safe_dump(dict(config), sort_keys=False))

    def read_config(self) -> dict[str, Any]:
        """Returns the resolved config as plain data."""
        try:
            config = read_yaml(self.config_path)
        except UsageError as error:
            raise RunFolderError(f"{error}; restore the file") from None
        if not isinstance(config, dict):
            raise RunFolderError(f"{self.config_path} holds no config; restore the file")
        return config

    def config(self, algorithm: str | None = None) -> TrainConfig:
        """Returns the resolved config as its model; see `validated_run` for `algorithm`."""
        return validated_run(self.read_config(), str(self.config_path), algorithm)

    def note_machine(self, machine: Mapping[str, Any]) -> None:
        """Adds what the run is computed with to machine.json, unless it was there last."""
        path = self.path / "machine.json"
        noted: list[Any] = []
        if path.is_file():
            try:
                noted = json.loads(path.read_text(encoding="utf-8"))
                if not isinstance(noted, list):
                    raise ValueError("no list of machines")
            except (ValueError, RecursionError) as error:
                set_aside(path, error)
                noted = []
        if noted[-1:] != [machine]:
            replace_text(path, json.dumps([*noted, machine], indent=1) + "\n")

    def log_metrics(self, frames: int, metrics: Mapping[str, float]) -> None:
        """Appends one row to metrics.csv and logs the same values to TensorBoard and wandb."""
        self._prepare()
        append_rows(self.metrics_path, [{"frames": frames, **metrics}])
        self._plot(frames, metrics)

    def _plot(self, frames: int, values: Mapping[str, float]) -> None:
        folder = self.path / "tensorboard"
        if not folder.is_dir():  # not yet, or somebody removed it: then its writer fails
            others = [each for each in self._loggers if not isinstance(each, TensorboardLogger)]
            self._loggers = [TensorboardLogger(folder.name, str(self.path)), *others]
        with naming(folder):
            for logger in self._loggers:
                logger.log_metrics(dict(values), frames)

    def log_to_wandb(self, mode: str, config: Mapping[str, Any]) -> None:
        """Sends everything logged from now on to Weights & Biases too, unless `mode` is "off".

        A resumed run continues its own wandb run, whose id is kept in the folder.
        """
        if mode == "off":
            return
        require(f"wandb={mode}", "train,wandb", "wandb")
        from torchrl.record.loggers.wandb import WandbLogger

        kept = self.path / "wandb_id"
        if not kept.is_file():
            replace_text(kept, uuid.uuid4().hex[:12])
        name = kept.read_text(encoding="utf-8")
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):  # it becomes a part of paths
            raise RunFolderError(f"{kept} holds no id of a wandb run: restore it, or remove it")
        logger = WandbLogger(
            self.path.name,
            project="flowrep",
            save_dir=str(self.path),
            id=name,
            mode=mode,
            config=dict(config),
            log_env_packages=False,
        )
        self._loggers.append(logger)

    def forget_after(self, frames: int) -> None:
        """Drops the rows logged after `frames`; a resumed run writes them again."""
        for path, rows, columns in (
            (self.metrics_path, self.read_metrics(), None),
            (self.evaluation_path, self.read_episodes(), EVALUATION_COLUMNS),
        ):
            kept = [row for row in rows if int(row["frames"]) <= frames]
            if len(kept) < len(rows) or not is_whole(path):
                write_rows(path, kept, columns)

    def start_again(self, first_save: int) -> None:
        """Drops all rows of a run that was killed before its first checkpoint, to start it again.

        Rows of more frames than `first_save`, when the first one is due, show that there was one.
        """
        episodes = self.read_episodes()
        rows = [*self.read_metrics(), *episodes]
        if any(row["evaluation"] != "training" for row in episodes) or any(
            int(row["frames"]) > first_save for row in rows
        ):
            raise RunFolderError(
                f"{self.checkpoint_path} is missing, and starting again would delete the run's "
                "results: restore that file, or move the folder away and start a new run"
            )
        self.forget_after(0)

    def read_metrics(self) -> list[dict[str, str]]:
        """Returns the rows of metrics.csv, none if there is no such file."""
        return read_rows(self.metrics_path, ["frames"], {"frames": int})

    def read_episodes(self) -> list[dict[str, str]]:
        """Returns the rows of evaluation.csv, none if there is no such file."""
        later = dict.fromkeys(("scene_id", "path"), "")  # columns that older tables lack
        needed = [name for name in EVALUATION_COLUMNS if name not in later]
        return [later | row for row in read_rows(self.evaluation_path, needed, _CHECKS)]

    def log_episodes(
        self,
        rows: Sequence[Mapping[str, Any]],
        positions: Sequence[NDArray[np.float32]] = (),
        table: Rows | None = None,
    ) -> None:
        """Saves evaluated episodes and logs their means to TensorBoard and wandb.

        They are of one agent after some frames. `positions` are where the vehicle was in each,
        `[T + 1, 2]`; not kept if empty.
        """
        self.save_episodes(rows, table)  # first: they took hours, and drives are only for pictures
        if positions:
            self._save_drives(rows, positions)
        self._plot(int(rows[0]["frames"]), _scalars(rows))

    def save_episodes(self, rows: Iterable[Mapping[str, Any]], table: Rows | None = None) -> None:
        """Adds evaluated episodes to evaluation.csv, or to a table that replaces it.

        An episode that is there already, with the same policy, frames, speed and frame rate, is
        replaced in place, and others follow the one that they follow in `rows`. So an evaluation
        that was interrupted and run again leaves the table of one that was not.
        """
        self._prepare()
        before = self.read_episodes() if table is None else table
        new = [{name: str(row[name]) for name in EVALUATION_COLUMNS} for row in rows]
        merged = _merged(*({_identity(row): row for row in part} for part in (before, new)))
        write_rows(self.evaluation_path, merged, EVALUATION_COLUMNS)

    def _save_drives(
        self, rows: Iterable[Mapping[str, Any]], positions: Iterable[NDArray[np.float32]]
    ) -> None:
        """Adds where vehicles drove to drives.npz, in place of the same episodes' earlier drives.

        It holds `positions` [sum of T + 1, 2], x and y in metres; `starts` [N + 1], so that episode
        n is `positions[starts[n]:starts[n + 1]]`; and the columns that name each episode.
        """
        drives = self._read_drives()
        drives |= {tuple(row[c] for c in _DRIVE): driven for row, driven in zip(rows, positions)}
        arrays: dict[str, Any] = {name: np.array(all_) for name, all_ in zip(_DRIVE, zip(*drives))}
        arrays["positions"] = np.concatenate([*drives.values()])
        arrays["starts"] = np.cumsum([0, *map(len, drives.values())])
        replace_file(self.drives_path, lambda path: np.savez_compressed(path, **arrays))

    def _read_drives(self) -> dict[tuple[Any, ...], NDArray[np.float32]]:
        """Returns the drives in drives.npz by what identifies them; sets a damaged file aside."""
        if not self.drives_path.is_file():
            return {}
        try:
            with np.load(self.drives_path, allow_pickle=False) as saved:
                names = zip(*(saved[column].tolist() for column in _DRIVE), strict=True)
                driven = np.split(saved["positions"], saved["starts"][1:-1])
                return dict(zip(names, driven, strict=True))
        except Exception as error:  # zip, zlib and numpy fail on garbage in a dozen ways
            set_aside(self.drives_path, error)
            return {}

    def write_failures(self) -> None:
        """Writes the causes of failure in evaluation.csv, in place of an older table."""
        write_rows(self.failures_path, failure_causes(self.read_episodes()))


def _identity(row: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in _EPISODE)


def _merged(
    before: Mapping[Any, Mapping[str, str]], new: Mapping[Any, Mapping[str, str]]
) -> list[Mapping[str, str]]:
    """Returns the rows of both by their keys, each new one after its predecessor in `new`."""
    places = {key: (number, 0) for number, key in enumerate(before)}
    known = [places[key][0] for key in new if key in places]
    last = known[0] - 1 if known else len(before)  # the first ones stand before their successor
    for number, key in enumerate(new, 1):
        last, _ = places.setdefault(key, (last, number))
    rows = {**before, **new}
    return [rows[key] for key in sorted(rows, key=places.__getitem__)]
