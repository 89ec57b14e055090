"""A run's folder: resolved config, metrics as CSV and TensorBoard, checkpoint, evaluation."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from torchrl.record.loggers import TensorboardLogger

from flowrep.experiment.tables import add_columns, append_rows, is_whole, read_rows, write_rows
from flowrep.experiment.weights_and_biases import open_wandb

EVALUATION_COLUMNS = (
    "scene",
    "representations",
    "flow",
    "seed",
    "frames",
    "policy",
    "speed",
    "fps",
    "episode_seed",
    "outcome",
    "hit",
    "return",
    "length",
)


class RunFolder:
    """The files of one run, by name.

    ```
    config.yaml              the resolved config, enough to resume or evaluate
    metrics.csv              a row for each logged step; tensorboard/ and wandb/ hold the same
    checkpoint/              what a resumed run continues from
    evaluation.csv           a row for each evaluated episode
    failures.csv             why episodes failed, by policy and speed
    videos/                  what the agent saw and did
    ```
    """

    def __init__(self, path: str | Path) -> None:
        """Creates the folder where it is missing."""
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._loggers: list[Any] = []

    @classmethod
    def existing(cls, path: str | Path) -> "RunFolder":
        """Opens a folder that holds a run, and creates none.

        Raises:
            FileNotFoundError: there is no run at `path`.
        """
        if not (Path(path) / "config.yaml").is_file():
            raise FileNotFoundError(
                f"'{path}' holds no run: it has no config.yaml. Give the folder that a training "
                "printed as its run folder"
            )
        return cls(path)

    @property
    def checkpoint_path(self) -> Path:
        """The file that holds the last complete state of the run."""
        return self.path / "checkpoint" / "latest.safetensors"

    @property
    def evaluation_path(self) -> Path:
        """The table of evaluated episodes."""
        return self.path / "evaluation.csv"

    @property
    def failures_path(self) -> Path:
        """The table of why episodes failed."""
        return self.path / "failures.csv"

    @property
    def metrics_path(self) -> Path:
        """The table of logged training steps."""
        return self.path / "metrics.csv"

    def video_path(self, name: str) -> Path:
        """The file for a video of that name."""
        (self.path / "videos").mkdir(exist_ok=True)
        return self.path / "videos" / f"{name}.mp4"

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the resolved config."""
        text = yaml.safe_dump(dict(config), sort_keys=False)
        whole = self.path / "config.yaml.tmp"
        whole.write_text(text, encoding="utf-8")
        whole.replace(self.path / "config.yaml")

    def read_config(self) -> dict[str, Any]:
        """Returns the resolved config that the run was started with."""
        return yaml.safe_load((self.path / "config.yaml").read_text(encoding="utf-8"))

    def log_metrics(self, frames: int, metrics: Mapping[str, float]) -> None:
        """Appends one row to metrics.csv and gives the same values to TensorBoard and wandb."""
        append_rows(self.metrics_path, [{"frames": frames, **metrics}])
        if not any(isinstance(logger, TensorboardLogger) for logger in self._loggers):
            self._loggers.append(TensorboardLogger("tensorboard", str(self.path)))
        for logger in self._loggers:
            logger.log_metrics(dict(metrics), frames)

    def log_to_wandb(self, mode: str, config: Mapping[str, Any]) -> None:
        """Gives what is logged from now on to Weights & Biases as well, unless `mode` is "off".

        Raises:
            ImportError: wandb is not installed.
        """
        if mode != "off":
            self._loggers.append(open_wandb(self.path, mode, config))

    def forget_after(self, frames: int) -> None:
        """Drops what was logged after `frames`: a resumed run writes those rows again."""
        for path in (self.metrics_path, self.evaluation_path):
            rows = read_rows(path)
            kept = [row for row in rows if int(row["frames"]) <= frames]
            if len(kept) < len(rows) or not is_whole(path):
                write_rows(path, kept)

    def is_evaluated(self, frames: int) -> bool:
        """Says whether the evaluation that ends a run of so many frames is in evaluation.csv."""
        return any(
            row["policy"] == "sampled" and int(row["frames"]) == frames
            for row in self.read_episodes()
        )

    def read_episodes(self) -> list[dict[str, str]]:
        """Returns the rows of evaluation.csv, none where there is no such file."""
        return read_rows(self.evaluation_path)

    def log_episodes(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Appends evaluated episodes to evaluation.csv, first giving an older one its new columns.

        What an older table did not say stays empty.
        """
        add_columns(self.evaluation_path, EVALUATION_COLUMNS)
        append_rows(self.evaluation_path, rows, EVALUATION_COLUMNS)
