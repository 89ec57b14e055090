"""Where a run's numbers are plotted: TensorBoard and Weights & Biases."""

from __future__ import annotations

import re
import uuid
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from flowrep.config.usage import UsageError
from flowrep.experiment.outcomes import OUTCOMES, EpisodeRecord
from flowrep.extras import require
from flowrep.files import naming, replace_text

if TYPE_CHECKING:
    from torchrl.record.loggers import TensorboardLogger


class Loggers:
    """Logs to TensorBoard in a run's folder and, after `add_wandb`, to Weights & Biases."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._tensorboard: TensorboardLogger | None = None
        self._wandb: Any = None

    def log(self, frames: int, values: Mapping[str, float]) -> None:
        """Logs values by title."""
        events = self._folder / "tensorboard"
        if not events.is_dir():  # new, or somebody removed it, so that the old writer would fail
            self._tensorboard = None
        with naming(events):
            if self._tensorboard is None:
                # Imports PyTorch, before which commands open their folders.
                from torchrl.record.loggers import TensorboardLogger

                self._tensorboard = TensorboardLogger(events.name, str(self._folder))
            for logger in filter(None, (self._tensorboard, self._wandb)):
                logger.log_metrics(dict(values), frames)

    def log_episodes(self, records: Sequence[EpisodeRecord]) -> None:
        """Logs shares of outcomes, mean return and mean length, by scene, condition and policy."""
        values: dict[str, list[float]] = defaultdict(list)
        for each in records:
            # "training" would be taken for the episodes from which the agent learns.
            kind = each.evaluation.replace("training", "evaluation")
            title = "/".join((kind, each.scene, each.speed, f"{each.fps:g}fps", each.policy))
            for name in OUTCOMES:
                values[f"{title}/{name}"].append(each.outcome == name)
            values[f"{title}/return"].append(each.return_)
            values[f"{title}/length"].append(each.length)
        self.log(records[0].frames, {title: fmean(all_) for title, all_ in values.items()})

    def flush(self) -> None:
        """Writes what TensorBoard's writer still holds."""
        if self._tensorboard is not None:
            self._tensorboard.experiment.flush()

    def add_wandb(self, mode: str, config: Mapping[str, Any]) -> None:
        """Sends everything logged from now on to Weights & Biases too, unless `mode` is "off".

        A resumed run continues its wandb run, whose id is in the folder.
        """
        if mode == "off":
            return
        require(f"wandb={mode}", "train,wandb", "wandb")
        kept = self._folder / "wandb_id"
        if not kept.is_file():
            replace_text(kept, uuid.uuid4().hex[:12])
        name = kept.read_text(encoding="utf-8")
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):  # it becomes a part of paths
            raise UsageError(f"{kept} does not hold a wandb run's id: restore or remove it")

        from torchrl.record.loggers.wandb import WandbLogger

        self._wandb = WandbLogger(
            self._folder.name,
            project="flowrep",
            save_dir=str(self._folder),
            id=name,
            mode=mode,
            config=dict(config),
            log_env_packages=False,
        )
