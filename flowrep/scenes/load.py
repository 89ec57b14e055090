"""Loads a scene from its name, a YAML file or plain data, and checks it; its schema for editors."""

import dataclasses
import json
import pickle
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, get_args, get_type_hints

import shapely
from pydantic import TypeAdapter, ValidationError

from flowrep.config_tree import CONF_DIR
from flowrep.scenes.checks import check_consistency, check_extent, check_paths, check_walks
from flowrep.scenes.layout import Layout
from flowrep.scenes.plain_data import PlainDataError, join, plain, read_yaml, shortened
from flowrep.scenes.scene import Scene, SceneError


@cache
def _adapter() -> TypeAdapter[Scene]:
    return TypeAdapter(Scene)


def scene_from_data(data: Any, *, source: str) -> Scene:
    """Returns a scene from a mapping whose keys are exactly the fields of `Scene`.

    Args:
        data: nested mappings, lists and values.
        source: the file, for messages.

    Raises:
        SceneError: a key is unknown or missing, or a value has the wrong type or is out of range.
    """
    try:
        content = plain(data)
    except PlainDataError as error:
        raise SceneError(source, error.key, str(error), "write plain keys and values") from error
    except RecursionError as error:
        raise SceneError(source, "", "is nested too deep", "write plain keys") from error
    if not isinstance(content, Mapping):
        problem = f"expected a mapping, got {shortened(repr(content))}"
        raise SceneError(source, "", problem, "write a scene's keys")
    try:
        return _adapter().validate_python(content)
    except ValidationError as error:
        # A misspelt key is also reported as missing; report the misspelling first.
        told = sorted(error.errors(include_url=False), key=lambda each: each["type"] != _UNKNOWN)
        raise SceneError(source, *_told(told[0])) from error


def json_schema() -> str:
    """Returns the JSON schema of scene files, as text."""
    schema = _adapter().json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(schema, indent=1) + "\n"


_UNKNOWN = "unexpected_keyword_argument"
_OUR_WORDS = {
    "Value error, give": "give",
    "Input should be": "it should be",
    "Tuple should have": "it should have",
    "String should have": "it should have",
    " after validation": "",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "a valid number": "a number",
    "a valid integer": "a whole number",
    "a valid tuple": "a list",
    "a valid dictionary": "a mapping",
    "a valid string": "text",
    "a valid boolean": "true or false",
}


def _told(error: Any) -> tuple[str, str, str]:
    """Returns the key, the problem and the remedy for a pydantic error."""
    *parents, last = error["loc"]
    key = ""
    for part in (*parents, last):
        key = f"{key}[{part}]" if isinstance(part, int) else join(key, part)
    kind, message = error["type"], error["msg"]
    if kind == _UNKNOWN:
        return key, "unknown key", f"the keys are: {', '.join(_keys_at(parents))}"
    if kind == "missing":
        what = "value" if isinstance(last, int) else "key"
        return key, f"missing {what}", "add it"
    problem = f"got {shortened(repr(error['input']))}"
    if kind == "string_pattern_mismatch":
        letters = "letters, digits, - and _" if key == "name" else "text with no space at its ends"
        return key, problem, f"give a name: {letters}"
    if kind == "dataclass_type":
        return key, problem, "it should be a mapping: write its keys"
    for theirs, ours in _OUR_WORDS.items():
        message = message.replace(theirs, ours)
    return key, problem, message


def _keys_at(location: Sequence[str | int]) -> list[str]:
    """Returns the keys of the part of a scene at a location."""
    part: Any = Scene
    for name in location:
        if isinstance(name, str):
            part = _dataclass_in(get_type_hints(part)[name])
    return [field.name for field in dataclasses.fields(part)]


def _dataclass_in(hint: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return hint
    return next(filter(None, map(_dataclass_in, get_args(hint))), None)


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
