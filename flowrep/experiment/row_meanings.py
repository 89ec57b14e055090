"""What rows of evaluation.csv mean beyond their columns, kept in files beside the table.

A row knows its scene by its name alone, and of what a policy of the user's own saw only the names.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from flowrep.experiment.run import RunFolder, RunFolderError


def scene_file(run: RunFolder, name: str) -> Path:
    """Returns the file for a scene, whole, in which rows were run; not for the run's own."""
    return run.path / "scenes" / f"{name}.yaml"


def maps_file(run: RunFolder, policy: str) -> Path:
    """Returns the file for what a policy of the user's own saw.

    Args:
        run: the folder of its table.
        policy: its name, without characters that a file can't have.
    """
    return run.path / "maps" / f"{policy}.yaml"


def known(path: Path) -> dict[str, Any] | None:
    """Returns what a file holds, None if there is none.

    Raises:
        RunFolderError: the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError):
        data = None
    if not isinstance(data, dict):
        raise RunFolderError(
            f"{path} is not what was evaluated: restore it, or delete it together with the rows "
            f"of '{path.stem}' in {path.parent.parent / 'evaluation.csv'}"
        )
    return data


def keep(path: Path, data: Mapping[str, Any]) -> None:
    """Writes data, unless that is what the file holds.

    Raises:
        OSError: it can't be written.
    """
    text = yaml.safe_dump(dict(data), sort_keys=False).encode()
    if path.is_file() and path.read_bytes() == text:
        return
    path.parent.mkdir(exist_ok=True)
    whole = path.with_suffix(".tmp")
    whole.write_bytes(text)
    whole.replace(path)
