"""The scenes of a run's evaluations elsewhere, kept whole: rows know theirs by its name alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from flowrep.experiment.run_folder import RunFolder, RunFolderError


def known_scene(run: RunFolder, name: str) -> dict[str, Any] | None:
    """Returns the scene of that name in which episodes were run, None if it wasn't kept.

    Raises:
        RunFolderError: its file is damaged.
    """
    path = _path(run, name)
    if not path.is_file():
        return None
    try:
        scene = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError):
        scene = None
    if not isinstance(scene, dict):
        raise RunFolderError(
            f"{path} is not the scene that was evaluated: restore it, or delete it together with "
            f"the rows of '{name}' in {run.evaluation_path}"
        )
    return scene


def keep_scene(run: RunFolder, scene: Mapping[str, Any]) -> None:
    """Writes a scene to `scenes/<name>.yaml`, unless that is what the file holds.

    Raises:
        OSError: it can't be written.
    """
    path = _path(run, scene["name"])
    data = yaml.safe_dump(dict(scene), sort_keys=False).encode()
    if path.is_file() and path.read_bytes() == data:
        return
    path.parent.mkdir(exist_ok=True)
    whole = path.with_suffix(".tmp")
    whole.write_bytes(data)
    whole.replace(path)


def _path(run: RunFolder, name: str) -> Path:
    return run.path / "scenes" / f"{name}.yaml"
