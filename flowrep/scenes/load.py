"""Loads and checks a scene, given by name, YAML file or mapping."""

import dataclasses
import pickle
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from flowrep.config.usage import UsageError, closest_first
from flowrep.config.yaml_file import CONF_DIR, read_yaml
from flowrep.scenes.checks import check_path, check_references, check_walks
from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import Scene, SceneError


def load_scene(scene: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Returns a checked scene.

    Args:
        scene: the name of a file in `conf/scene`, the path of a YAML file, a mapping of its keys,
            or a `Scene`, which is checked again.

    Raises:
        SceneError: the scene is unknown or invalid; the message names file and key.

    >>> load_scene("straight_road").time_limit_steps
    200
    """
    if isinstance(scene, Scene):
        return _checked(pickle.dumps(scene))
    if isinstance(scene, Mapping):
        return _loaded(scene, f"scene {scene.get('name', 'without a name')!r}")
    path = Path(scene)
    if path.suffix not in (".yaml", ".yml"):
        if str(scene) not in scene_names():
            known = closest_first(str(scene), scene_names())
            raise SceneError(f"unknown scene {str(scene)!r}; choose one of {known}, or a YAML file")
        path = CONF_DIR / "scene" / f"{scene}.yaml"
    try:
        data = read_yaml(path)
    except UsageError as error:
        raise SceneError(str(error)) from error
    loaded = _loaded(data, str(path))
    if loaded.name != path.stem:  # results are filed under the name
        raise SceneError(f"{path}: name: is {loaded.name!r}; give the file's name, {path.stem!r}")
    return loaded


def scene_names() -> list[str]:
    """Returns the names of the scenes in `conf/scene`."""
    return sorted(path.stem for path in (CONF_DIR / "scene").glob("*.yaml"))


def scene_data(scene: Scene) -> dict[str, Any]:
    """Returns a scene as YAML has it, without keys that have their default.

    >>> load_scene(scene_data(load_scene("s_turn"))) == load_scene("s_turn")
    True
    """
    data: dict[str, Any] = _adapter().dump_python(scene, mode="json", exclude_defaults=True)
    return data


@cache
def _adapter() -> TypeAdapter[Scene]:
    return TypeAdapter(Scene)


# Many envs use the same scene, which is then checked only once. The key of the cache is the pickled
# scene, because scenes contain mappings and have no hash.
@lru_cache(maxsize=8)
def _checked(pickled: bytes) -> Scene:
    scene = pickle.loads(pickled)
    return _loaded(dataclasses.asdict(scene), f"scene {scene.name!r}")


def _loaded(data: Any, source: str) -> Scene:
    try:
        scene = _adapter().validate_python(data)
        check_references(scene)
        layout = Layout(scene)
        for path in scene.paths:
            check_path(layout, path)
        check_walks(layout)
    except ValidationError as error:
        raise SceneError(f"{source}: {_complaint(error)}") from error
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from error
    return scene


def _complaint(error: ValidationError) -> str:
    # pydantic reports a misspelt key twice: as unknown, and as missing under its right name. Report
    # the misspelling.
    first = min(error.errors(), key=lambda each: each["type"] != "unexpected_keyword_argument")
    key = "".join(f"[{at}]" if isinstance(at, int) else f".{at}" for at in first["loc"])[1:]
    if first["type"] == "unexpected_keyword_argument":
        return f"{key}: unknown key; the keys are in docs/scene.schema.json"
    problem = first["msg"].removeprefix("Value error, ")
    given = "" if first["type"] == "missing" else f"; got {first['input']!r:.60}"
    return f"{key}: {problem}{given}"
