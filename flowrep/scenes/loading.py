"""Loads a scene from its name, a YAML file or plain data, and checks it."""

import dataclasses
import pickle
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import shapely

from flowrep.config_tree import CONF_DIR
from flowrep.scenes.consistency import check_consistency
from flowrep.scenes.ground_checks import check_extent, check_paths
from flowrep.scenes.layout import Layout
from flowrep.scenes.plain_data import PlainDataError, read_yaml, shortened
from flowrep.scenes.scene import Scene
from flowrep.scenes.schema import SceneError, scene_from_data
from flowrep.scenes.walk_checks import check_walks


def load_scene(scene: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Returns a checked scene.

    Args:
        scene: the name of a file in `conf/scene`, the path of a YAML file, a mapping of its keys,
            or a `Scene`, which is checked again.

    Raises:
        SceneError: names the file, the key, what was expected and the remedy.

    >>> load_scene("straight_road").time_limit_steps
    200
    """
    if isinstance(scene, Scene):
        return _checked(pickle.dumps(scene))
    data, source = _data(scene)
    return _loaded(data, source)


@lru_cache(maxsize=8)
def _checked(pickled: bytes) -> Scene:
    """Returns a checked scene; each of many environments is given the same one.

    The key is the scene's bytes, as it holds mappings and so has no hash.
    """
    scene = pickle.loads(pickled)
    return _loaded(dataclasses.asdict(scene), f"scene {shortened(repr(scene.name))}")


def _loaded(data: Any, source: str) -> Scene:
    loaded = scene_from_data(data, source=source)
    check_consistency(loaded, source)
    try:
        check_extent(loaded, source)
        layout = Layout(loaded)
        check_paths(layout, source)
        check_walks(layout, source)
    except shapely.errors.GEOSException as error:
        problem = f"can't be laid out: {shortened(str(error), 120)}"
        raise SceneError(source, "roads", problem, "give simpler roads and walks") from error
    return loaded


def scene_names() -> list[str]:
    """Returns the names of the scenes in `conf/scene`."""
    return sorted(path.stem for path in (CONF_DIR / "scene").glob("*.yaml"))


def _data(scene: str | Path | Mapping[str, Any]) -> tuple[Any, str]:
    if isinstance(scene, Mapping):
        name = shortened(repr(scene.get("name", "without a name")))
        return scene, f"scene {name}"
    path = _find(scene)
    try:
        return read_yaml(path), str(path)
    except PlainDataError as error:
        raise SceneError(str(path), error.key, str(error), "fix the file") from error


def _find(scene: str | Path) -> Path:
    path = Path(scene)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise SceneError(str(path), "", "there is no such file", "give an existing YAML file")
        return path
    if str(scene) not in scene_names():
        known = ", ".join(scene_names())
        name = shortened(repr(str(scene)))
        raise SceneError(
            f"scene {name}", "", "unknown name", f"choose one of {known}, or give a file"
        )
    return CONF_DIR / "scene" / f"{scene}.yaml"
