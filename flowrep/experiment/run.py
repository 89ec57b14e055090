"""A run's folder: its config, tables of metrics and episodes, and checkpoint.

Commands open the folders that they are given before they import PyTorch, so here only the functions
that need it import it.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import yaml
from filelock import FileLock, Timeout

from flowrep.config.usage import UsageError
from flowrep.config.yaml_file import read_yaml
from flowrep.experiment.outcomes import COLUMNS, OUTCOMES, EpisodeRecord, columns_for, read_episodes
from flowrep.experiment.provenance import differences
from flowrep.experiment.schema import TrainConfig, validated_run
from flowrep.files import (
    append_rows,
    naming,
    read_rows,
    refuse_link,
    replace_text,
    whole_number,
    write_rows,
)

if TYPE_CHECKING:
    from torchrl.record.loggers import TensorboardLogger


class RunFolderError(ValueError):
    """A folder holds no run, or holds one where a new run should begin."""


class FolderInUseError(OSError):
    """Another process works in the folder."""


_TIMES = ("started", "ended")


class RunFolder:
    """The files of one run, by name; docs/runs.md says what is in them."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_path = self.path / "config.yaml"
        self.metrics_path = self.path / "metrics.csv"
        self.checkpoint_path = self.path / "checkpoint" / "latest.safetensors"
        self.evaluation_path = self.path / "evaluation.csv"
        self._tensorboard: TensorboardLogger | None = None

    @classmethod
    def existing(cls, path: str | Path) -> RunFolder:
        """Opens the folder of an existing run."""
        if not (Path(path) / "config.yaml").is_file():
            raise RunFolderError(
                f"'{path}' holds no run: it has no config.yaml. Give the folder that a training "
                "printed as its run folder"
            )
        return cls(path)

    @classmethod
    def all_in(cls, paths: Iterable[str | Path]) -> list[RunFolder]:
        """Opens the runs in folders, at any depth, each once."""
        found: dict[Path, RunFolder] = {}
        for path in map(Path, paths):
            # Hydra leaves copies of a run's config.yaml inside of its folder, as wandb did.
            runs = [
                config.parent
                for config in sorted(path.rglob("config.yaml"))
                if {".hydra", "wandb"}.isdisjoint(config.relative_to(path).parts)
            ]
            if not runs:
                what = "holds no run" if path.exists() else "does not exist"
                raise RunFolderError(f"'{path}' {what}: give the folder of a run or of a sweep")
            for run in runs:
                found.setdefault(run.resolve(), cls(run))
        return list(found.values())

    def check_is_new(self) -> None:
        """Checks that a run can begin here."""
        files = (self.config_path, self.metrics_path, self.evaluation_path, self.checkpoint_path)
        for file in files:
            if file.exists():
                is_run = file == self.config_path
                how = f"continue it with resume={self.path}, or " if is_run else ""
                raise RunFolderError(
                    f"'{self.path}' holds a run already ({file.name}): {how}give the new one "
                    "another folder with hydra.run.dir="
                )

    @contextmanager
    def locked(self, patience_s: float = 0.0) -> Iterator[None]:
        """Creates the folder, and locks it against other processes until the context ends.

        The kernel ends the lock with the process, even if that is killed. Another process may take
        `patience_s` to release the folder.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        # In a stranger's folder: TensorBoard and FFmpeg would write through them.
        for name in (".lock", "checkpoint", "tensorboard", "videos"):
            refuse_link(self.path / name)
        lock = FileLock(self.path / ".lock")
        try:
            lock.acquire(timeout=patience_s)
        except Timeout:
            raise FolderInUseError(
                f"'{self.path}' is in use: another process trains or evaluates in it. Wait until "
                "it has ended, or stop it"
            ) from None
        try:
            yield
        finally:
            lock.release()

    def video_path(self, name: str) -> Path:
        """Returns the path of the video with this name."""
        return self.path / "videos" / f"{name}.mp4"

    def write_total_frames(self, total_frames: int) -> None:
        """Writes to a run's config that it is longer, unless it says so already."""
        config = self.read_config()
        if config["total_frames"] != total_frames:
            self.write_config(config | {"total_frames": total_frames})

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the resolved config."""
        self.path.mkdir(parents=True, exist_ok=True)
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

    def config(self, trusted: Collection[str] = ()) -> TrainConfig:
        """Returns the resolved config as its model; see `validated_run` for `trusted`.

        `train.resumed` decides what `resume=` may change.
        """
        return validated_run(self.read_config(), str(self.config_path), trusted)

    def log_machine(self, machine: Mapping[str, Any]) -> None:
        """Notes in machine.json that a machine works on the run, from `started` to `ended` (UTC).

        If the last entry is of this machine, it is made longer.
        """
        path, now = self.path / "machine.json", datetime.now(UTC).isoformat(timespec="seconds")
        machines: Any = []
        if path.is_file():
            try:
                machines = json.loads(path.read_text(encoding="utf-8"))
            except ValueError as error:
                raise RunFolderError(f"{path} is damaged ({error}): restore or remove it") from None
        # Called at each save, so that a run that is killed has an `ended` close to its end.
        entry = {**machine, "started": now, "ended": now}
        if machines and machines[-1] == entry | {k: machines[-1].get(k) for k in _TIMES}:
            entry["started"] = machines.pop()["started"] or now
        replace_text(path, json.dumps([*machines, entry], indent=1) + "\n")

    def log_metrics(self, frames: int, metrics: Mapping[str, float]) -> None:
        """Appends one row to metrics.csv and logs the same values to TensorBoard."""
        append_rows(self.metrics_path, [{"frames": frames, **metrics}])
        self._plot(frames, metrics)

    def forget_after(self, frames: int) -> None:
        """Drops the rows logged after `frames`; a resumed run writes them again."""
        metrics, episodes = self.read_metrics(), self.read_episodes()
        for path, rows in ((self.metrics_path, metrics), (self.evaluation_path, episodes)):
            # Written again in any case, as half a last line would become a part of the next row.
            write_rows(path, [row for row in rows if int(row["frames"]) <= frames])

    def start_again(self, first_save: int) -> None:
        """Drops all rows of a run that was killed before its first checkpoint, to start it again.

        The first checkpoint is due after `first_save` frames: rows of more frames show that there
        was one, and that its file is lost.
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
        return read_rows(self.metrics_path, ["frames"], {"frames": whole_number})

    def read_episodes(self) -> list[dict[str, str]]:
        """Returns the rows of evaluation.csv, none if there is no such file."""
        return read_episodes(self.evaluation_path)

    def log_episodes(self, records: Sequence[EpisodeRecord]) -> None:
        """Saves evaluated episodes, and logs their means to TensorBoard, by condition."""
        self.save_episodes(records)
        values: dict[str, list[float]] = defaultdict(list)
        for each in records:
            # "training" would be taken for the episodes from which the agent learns.
            kind = each.evaluation.replace("training", "evaluation")
            title = "/".join((kind, each.scene, each.speed, f"{each.fps:g}fps", each.policy))
            for name in OUTCOMES:
                values[f"{title}/{name}"].append(each.outcome == name)
            values[f"{title}/return"].append(each.return_)
            values[f"{title}/length"].append(each.length)
        self._plot(records[0].frames, {title: fmean(all_) for title, all_ in values.items()})

    def _plot(self, frames: int, values: Mapping[str, float]) -> None:
        """Logs values to TensorBoard by title."""
        with naming(self.path / "tensorboard"):
            if self._tensorboard is None:
                # Imports PyTorch, before which commands open their folders.
                from torchrl.record.loggers import TensorboardLogger

                self._tensorboard = TensorboardLogger("tensorboard", str(self.path))
            self._tensorboard.log_metrics(dict(values), frames)

    def flush(self) -> None:
        """Writes what TensorBoard's writer still holds."""
        if self._tensorboard is not None:
            self._tensorboard.experiment.flush()

    def note_maps(self, policy: str, scene_id: str, maps: dict[str, Any]) -> None:
        """Notes in maps.yaml what a policy without a run sees in a scene.

        Raises RunFolderError if it saw something else in episodes that the new ones would replace.
        """
        path, name = self.path / "maps.yaml", f"{policy} in scene {scene_id}"
        noted = read_yaml(path) if path.is_file() else {}
        for row in self.read_episodes():
            if (row["policy"], row["scene_id"]) == (policy, scene_id):
                before = maps | {"order": row["representations"].split("+")}  # without a note
                for key, was, now in differences(noted.get(name, before), maps):
                    raise RunFolderError(
                        f"'{self.path}' holds episodes of {name} with {key}={was}; those with "
                        f"{key}={now} would replace them: give another folder with output="
                    )
        replace_text(path, yaml.safe_dump(noted | {name: maps}, sort_keys=False))

    def save_episodes(self, records: Iterable[EpisodeRecord]) -> None:
        """Adds evaluated episodes to evaluation.csv, in place of earlier rows of the same episodes.

        They go to the end, so that running the same evaluation again results in the same file.
        """
        key_of = itemgetter(*columns_for("key"))
        # As text, as a table's rows are read, so that both have the same keys.
        new = [{name: str(cell) for name, cell in each.row().items()} for each in records]
        again = {key_of(row) for row in new}
        kept = [row for row in self.read_episodes() if key_of(row) not in again]
        write_rows(self.evaluation_path, [*kept, *new], COLUMNS)
