"""Logs a run's metrics to Weights & Biases."""

import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MODES = ("off", "offline", "online")


def open_wandb(folder: Path, mode: str, config: Mapping[str, Any]) -> Any:
    """Returns a TorchRL logger to the folder's own wandb run, the same one whenever it is resumed.

    Args:
        folder: the run's folder; wandb writes its files to `wandb/` in it.
        mode: "offline" keeps them there for `wandb sync`, "online" sends them.
        config: shown beside the run.

    Raises:
        ImportError: wandb is not installed.
    """
    try:
        import wandb  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"wandb={mode} needs packages of an extra: pip install 'flowrep[train,wandb]'"
        ) from error
    from torchrl.record.loggers.wandb import WandbLogger

    return WandbLogger(
        folder.name,
        project="flowrep",
        save_dir=str(folder),
        id=run_id(folder),
        mode=mode,
        config=dict(config),
        log_env_packages=False,
    )


def run_id(folder: Path) -> str:
    """Returns wandb's id of the run, generated once and kept in its folder."""
    kept = folder / "wandb_id"
    if not kept.is_file():
        fresh = folder / "wandb_id.tmp"
        fresh.write_text(uuid.uuid4().hex[:12], encoding="utf-8")
        fresh.replace(kept)
    return kept.read_text(encoding="utf-8")
