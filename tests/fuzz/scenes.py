"""Scene files: each is a scene that can be driven, or is refused with file, key and remedy."""

import copy
import datetime
import random
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flowrep.config_tree import CONF_DIR
from flowrep.envs.episode import Rules, ticks_for
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.layout import Layout
from flowrep.scenes.pedestrians import draw_crowd
from tests.fuzz.framework import Part

_CROSSROADS = Path(__file__).parents[1] / "scenes" / "crossroads.yaml"
_ODD: list[Any] = [
    *(float("nan"), float("inf"), -float("inf"), 0, 0.0, -0.0, -1, -1.0, 0.5, 1.5, 3, 1e-9, -1e-9),
    *(1e-300, 1e6, 1e9, 1e300, 2**31, 2**53, 2**63, 10**400, -(10**30), 5000.0, 99.0, 360, -360.0),
    *(True, False, None, "", " ", "x", "1", "nan", "../x", "a\nb", "é", "x" * 3000, b"bytes"),
    *([], {}, [1], [0, 0], [1.0, 2.0], [2.0, 1.0], [[[]]], {"a": 1}, {None: 1}, {1: 2}),
    *(datetime.date(2026, 1, 2), datetime.datetime(2026, 1, 2, 3), {1, 2}),
]
_TEXTS = [
    *("[" * 3000, "{a: " * 2000, "- " * 3000, "&a [*a]", "*b", "<<: 3", "<<: [*x, *x]", "\t", "\0"),
    *("2001-99-99", "2001-12-32 25:61:61", "!!int ''", "!!float x", "!!binary '='", "!!set {a}"),
    *(
        "!!timestamp x",
        "!!python/object:os.system {}",
        "!!omap [1]",
        "!!pairs [a]",
        "!x y",
        "? [a]",
    ),
    *("1:2:3:4:5:6", "0x" + "f" * 400, "9" * 5000, "\ufeff", "\u2028", "%YAML 9.9", "---\n---"),
    *("name: a\nname: b\n", "'", '"', "|", ">", "#", ": ", "- ", "\n", "é" * 50, "1e999", "-.inf"),
]


@cache
def _bases() -> list[Any]:
    files = [_CROSSROADS, *sorted((CONF_DIR / "scene").glob("*.yaml"))]
    whole = [yaml.safe_load(file.read_text(encoding="utf-8")) for file in files]
    # Without most of what is drawn beside the road, a scene is laid out in no time.
    bare = [dict(scene, building_rows=scene.get("building_rows", [])[:1]) for scene in whole]
    return [*whole, *bare, *bare, *bare]


def draw(rng: random.Random) -> bytes:
    """Returns the content of a scene file with one to three odd changes."""
    data = copy.deepcopy(rng.choice(_bases()))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(data))
        if places:
            rng.choice(_CHANGES)(data, *rng.choice(places), rng)
    content = yaml.dump(data, allow_unicode=True, sort_keys=False).encode("utf-8", "replace")
    return _spoilt(content, rng) if rng.random() < 0.2 else content


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Yields every container with each of its keys or numbers."""
    keys: list[Any] = []
    if isinstance(data, dict):
        keys = list(data)
    elif isinstance(data, list):
        keys = list(range(len(data)))
    for key in keys:
        yield data, key
        yield from _places(data[key])


def _make_odd(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    at[key] = copy.deepcopy(rng.choice(_ODD))


def _scale(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    if isinstance(at[key], (int, float)) and not isinstance(at[key], bool):
        factor = rng.choice((-1, 0.1, 0.5, 0.9, 1.1, 2, 10, 100, 1e-3, 1e3, 1e-6, 1e6))
        at[key] = type(at[key])(at[key] * factor)
    else:
        _make_odd(data, at, key, rng)


def _move(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    numbers = [place for place in _places(data) if isinstance(place[0][place[1]], float)]
    if numbers:
        there, name = rng.choice(numbers)
        there[name] += rng.choice((-30.0, -5.0, -1.0, -0.3, 0.3, 1.0, 5.0, 30.0))


def _delete(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    del at[key]


def _rename(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    if isinstance(at, dict):
        at[rng.choice((None, 1, "", "nam", f"{key} ", True, 1.5))] = at.pop(key)


def _repeat(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    if isinstance(at[key], list):
        at[key] = at[key] * rng.choice((2, 10, 2000))
    elif isinstance(at, list):
        at += [copy.deepcopy(at[key]) for _ in range(rng.choice((1, 5, 200)))]


def _swap(data: Any, at: Any, key: Any, rng: random.Random) -> None:
    there, name = rng.choice(list(_places(data)))
    at[key], there[name] = copy.deepcopy(there[name]), copy.deepcopy(at[key])


_CHANGES = [_make_odd, _make_odd, _scale, _scale, _scale, _move, _move, _move, _delete, _rename]
_CHANGES += [_repeat, _swap]


def _spoilt(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    text = rng.choice(_TEXTS).encode("utf-8", "surrogatepass")
    length = rng.choice((0, 0, 1, 5, 50, len(content)))
    odd = rng.choice((text, text, text, b"\xff\xfe", bytes([rng.randrange(256)]), content * 30))
    return content[:at] + odd + content[at + length :]


def run(content: bytes) -> str:
    """Loads the file; a scene that is taken must have room for its people and a clock."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "odd.yaml")
        file.write_bytes(content)
        try:
            scene = load_scene(file)
        except SceneError as error:
            message = str(error)
            assert message.startswith(f"{file}: "), message
            assert "\n" not in message, message
            assert len(message) < len(str(file)) + 2000, message
            assert "; " in message, message
            return "refused"
    layout = Layout(scene)
    walking_mps = scene.pedestrian_speed_mps["high"]
    ticks = ticks_for(scene, scene.frame_rate_hz, walking_mps, scene.vehicle.speed_mps)
    Rules(layout, scene.frame_rate_hz, ticks)
    times = np.linspace(0.0, scene.time_limit_s, 50)[:, None]
    for speed_mps in scene.pedestrian_speed_mps.values():
        rng = np.random.default_rng(0)
        places = draw_crowd(layout, scene.pedestrian_groups, speed_mps, rng).positions(times)
        assert np.isfinite(places).all()
        one, other = np.triu_indices(places.shape[1], 1)
        gaps = np.linalg.norm(places[:, one] - places[:, other], axis=-1)
        assert gaps.min(initial=np.inf) >= 0.6 - 1e-9, gaps.min()
    return "taken"


PART = Part("scenes", draw, run, setup=lambda: [load_scene(base) for base in _bases()[:5]] and None)
