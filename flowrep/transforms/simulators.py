"""Simulators by name: `sensors_from("isaac_lab", ...)` returns the adapters of its conventions.

Each is a file in conf/simulator/, in TOML, which Python reads without another package. The axes and
layouts that these files name are defined in `geometry.pose`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tensordict.utils import NestedKey
from torchrl.envs.transforms import CatTensors, Transform

from flowrep.transforms.adapt import AdaptDepth, AdaptFlow, AdaptPose, MapLayout, Plane
from flowrep.transforms.flow import Intrinsics
from flowrep.transforms.maps import InstanceIds
from flowrep.transforms.motion import CameraMotion, InstanceMotion

_PARTS = "adapted"  # only the next adapter reads the keys under it


@dataclass(frozen=True, kw_only=True)
class Convention:
    """The names of a simulator's buffers, and the options of the adapters that convert them.

    Args:
        simulator: its name, and the version that has this convention.
        sources: documentation or code of the simulator that states it.
        tested_in: what tests it on the simulator, not only on buffers written as sources say.
        K: how to get K.
        layout: of maps, `"hw"` or `"hwc"`.
        depth: options of `AdaptDepth` for each depth buffer, the usual buffer first. The name of
            an argument of `sensors_from` stands for it, and has a default in `[name, default]`.
        pose: `keys` of the camera's pose (one, or position and quaternion); options of `AdaptPose`.
        bodies: the same of the bodies' poses.
        ids: `key` of instance ids; `background`, ids of pixels that show no body; options of
            `Plane`.
        flow: `key` of its flow, and options of `AdaptFlow`; empty if there is none, or unknown.
        notes: what else a user has to know.
    """

    simulator: str
    sources: Sequence[str]
    tested_in: str = ""
    K: str
    layout: MapLayout = "hw"
    depth: Mapping[str, Mapping[str, Any]]
    pose: Mapping[str, Any]
    bodies: Mapping[str, Any]
    ids: Mapping[str, Any]
    flow: Mapping[str, Any] = field(default_factory=dict)
    notes: str = ""


_FILES = sorted((Path(__file__).parents[1] / "conf/simulator").glob("*.toml"))
CONVENTIONS = {path.stem: Convention(**tomllib.loads(path.read_text("utf-8"))) for path in _FILES}


def sensors_from(
    simulator: str | Convention,
    *,
    depth: str | None = None,
    body_ids: Sequence[Any] | None = None,
    static_ids: Sequence[int] = (),
    flow: bool = False,
    intrinsics: Intrinsics | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    prefix: NestedKey = (),
    keys: Mapping[str, NestedKey] | None = None,
) -> list[Transform]:
    """Returns the adapters from a simulator's buffers to sensor keys.

    They write `("sensor", "depth")`, `"world_from_cam"` and `"prev_from_curr"`; with `body_ids`,
    `"world_from_body"`, `"instance"` and `"instance_motion"` too; with `flow`, `"raw"`.

    Args:
        simulator: a key of `CONVENTIONS`, or a convention of your own.
        depth: which of its depth buffers; by default the first.
        body_ids: ids (see its notes) of the bodies, in the order of their poses; for their motions.
        static_ids: ids of bodies that stand still and need no pose.
        flow: whether to read the simulator's flow.
        intrinsics: K `[3, 3]` or its key, for depth along the rays.
        near_m: the near plane, for depth from a z-buffer.
        far_m: the far plane, for depth from a z-buffer, or the depth that stands for the sky.
        prefix: the key under which all buffers are nested, by their names in the convention.
        keys: the keys of buffers that are elsewhere, by the buffers' names.

    Raises:
        ValueError: a name is unknown, or an argument is missing or isn't read.

    >>> sensors = sensors_from("mujoco", body_ids=[3, 4], far_m=20.0, prefix="camera")
    >>> sensors[-2]  # before RawFlow(K) and FlowFactorize(K) in a Compose
    InstanceIds([('adapted', 'segmentation')] -> [('sensor', 'instance')])
    """
    row = CONVENTIONS.get(simulator) if isinstance(simulator, str) else simulator
    if row is None:
        raise ValueError(f"unknown simulator {simulator!r}; known are {', '.join(CONVENTIONS)}")
    if static_ids and body_ids is None:
        raise ValueError("static_ids needs body_ids, the ids of the bodies that move")
    chosen = depth or next(iter(row.depth))
    if chosen not in row.depth:
        raise ValueError(f"{row.simulator} has no depth {chosen!r}; it has {', '.join(row.depth)}")
    if flow and not row.flow:
        raise ValueError(f"{row.simulator} has no flow whose convention is known: {row.notes}")
    given = {"intrinsics": intrinsics, "near_m": near_m, "far_m": far_m}
    arguments = {name: value for name, value in given.items() if value is not None}
    options: dict[str, Any] = {}
    for name, value in row.depth[chosen].items():
        argument, *default = value if isinstance(value, list) else [value]
        if argument in given and argument not in arguments and not default:
            raise ValueError(f"{row.simulator}'s {chosen} needs {argument}=; {row.notes}")
        options[name] = arguments.pop(argument, *default or [value])
    if arguments:
        raise ValueError(f"{row.simulator}'s {chosen} doesn't read {'=, '.join(arguments)}=")
    elsewhere = dict(keys or {})
    root = (prefix,) if isinstance(prefix, str) else tuple(prefix)

    def key(name: str) -> NestedKey:
        return elsewhere.pop(name, (*root, name) if root else name)

    def poses(written: NestedKey, *, keys: Sequence[str], **options: Any) -> list[Transform]:
        read = [key(name) for name in keys]
        if len(read) == 1:
            return [AdaptPose(**options, in_keys=read, out_keys=written)]
        joined: NestedKey = (_PARTS, written[-1])
        parts = CatTensors(read, joined, dim=-1, del_keys=False, sort=False)
        return [parts, AdaptPose(**options, in_keys=joined, out_keys=written)]

    adapters: list[Transform] = [Plane(row.layout, in_keys=key(chosen), out_keys=(_PARTS, chosen))]
    adapters += [AdaptDepth(**options, in_keys=(_PARTS, chosen))]
    adapters += [*poses(("sensor", "world_from_cam"), **row.pose), CameraMotion()]
    if body_ids is not None:
        ids = {"layout": row.layout, **row.ids}
        name, static = ids.pop("key"), [*ids.pop("background"), *static_ids]
        adapters += poses(("sensor", "world_from_body"), **row.bodies)
        adapters += [
            Plane(**ids, in_keys=key(name), out_keys=(_PARTS, name)),
            InstanceIds(body_ids, static_ids=static, in_keys=(_PARTS, name)),
            InstanceMotion(),
        ]
    if flow:
        options = {"channels_last": row.layout == "hwc", **row.flow}
        adapters.append(AdaptFlow(in_keys=key(options.pop("key")), **options))
    if elsewhere:
        raise ValueError(f"keys= names {sorted(elsewhere)}, which aren't read of {row.simulator}")
    return adapters
