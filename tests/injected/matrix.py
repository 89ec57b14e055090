"""What flowrep.diagnosis says of right data and of every mistake in them, cell by cell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from flowrep import geometry
from flowrep.diagnosis import Diagnosis, Examination, diagnose
from flowrep.sequences import EstimatedFlowSource, Frame
from flowrep.transforms import DIS
from tests.injected.mistakes import LISTED, UNLISTED
from tests.injected.sources import ENVS, RECORDINGS, Shots, ego_flow


def frames_of(shots: Shots, *, raw: bool) -> list[Frame]:
    return [
        Frame(
            name=f"{t}", source=Path(f"{t}"), world_from_cam=shots.poses[t].copy(), K=shots.K[t].copy(),
            depth=shots.depth[t].astype(np.float32), timestamp_s=t / 30,
            rgb=None if shots.rgb is None else shots.rgb[t],
            raw=shots.flow[t].astype(np.float32) if raw else None, raw_since=f"{t - 1}" if t else None,
        )
        for t in range(len(shots.depth))
    ]  # fmt: skip


@cache
def estimator() -> EstimatedFlowSource:
    return EstimatedFlowSource(DIS("fast"))


def with_estimated_flow(shots: Shots) -> Shots:
    """Returns shots whose flow is DIS's, stored as a file of the recording."""
    frames = frames_of(shots, raw=False)
    flow = [np.full((2, *shots.depth.shape[1:]), np.nan, np.float32)]
    flow += [estimator()(*both) for both in pairwise(frames)]
    return shots.with_(flow=np.array(flow))


def of_recording(shots: Shots) -> Diagnosis:
    """Returns the diagnosis of shots read as a recording."""
    is_recorded = shots.flow is not None
    frames, found = frames_of(shots, raw=is_recorded), Examination(flow_is_recorded=is_recorded)
    poses = [None, *(frame.world_from_cam for frame in frames), None]
    for t in range(1, len(frames)):
        raw = frames[t].raw if is_recorded else estimator()(*frames[t - 1 : t + 1])
        found.add(frames[t - 1], frames[t], raw, poses[t - 1], poses[t + 2])
    return found.diagnosis()


def tensordict_of(shots: Shots) -> tuple[TensorDict, torch.Tensor]:
    """Returns shots as an env gives them with flowrep's transforms, and K."""
    depth = torch.from_numpy(shots.depth.copy()).float().unsqueeze(1)
    ids = torch.zeros_like(depth, dtype=torch.long)
    if shots.ids is not None:
        ids = torch.from_numpy(shots.ids.copy()).long().unsqueeze(1)
    poses, K = torch.from_numpy(shots.poses.copy()), torch.from_numpy(shots.K[0]).float()
    previous = torch.cat([poses[:1], poses[:-1]])
    motion = torch.linalg.inv(previous) @ poses
    rows = motion.unsqueeze(1)
    if shots.moved is not None:
        rows = torch.linalg.inv(previous)[:, None] @ torch.from_numpy(shots.moved) @ poses[:, None]
    rows = torch.cat([motion.unsqueeze(1), rows[:, 1:]], 1).float()
    sensor = {"depth": depth, "instance": ids, "prev_from_curr": motion.float()}
    sensor |= {"instance_motion": rows, "world_from_cam": poses}
    if shots.rgb is not None:
        sensor["rgb"] = torch.from_numpy(shots.rgb.copy()).permute(0, 3, 1, 2)
    raw = geometry.rigid_flow(depth, ids, K, rows)
    parts = geometry.factorize(raw, depth, K, motion.float())
    flows = {"raw": raw.flow, "raw_valid": raw.valid, "ego": parts.ego, "obj": parts.obj}
    return TensorDict({"sensor": sensor, **flows}, [len(depth)]), K


def of_env(shots: Shots) -> Diagnosis:
    """Returns the diagnosis of shots as an env gives them."""
    return diagnose(*tensordict_of(shots))


def left_px(shots: Shots) -> float:
    """Returns the median of |raw - ego| by depth, K and poses as they are, by brute force."""
    left = [
        np.linalg.norm(shots.flow[t] - ego_flow(shots, t), axis=0)
        for t in range(1, len(shots.depth))
    ]
    return float(np.nanmedian(np.where(np.isnan(left), np.nan, left)))


@dataclass(frozen=True)
class Cell:
    """A mistake in a source. `effect_px` is what it adds to |raw - ego|, nan in an env."""

    source: str
    seed: int
    mistake: str
    found: Diagnosis
    named: tuple[str, ...]  # a part of the name that is wanted; empty if it is not in the table
    effect_px: float

    @property
    def kind(self) -> str:
        """Returns what came out."""
        found = self.found
        if found.verdict == "wrong":
            if self.mistake in UNLISTED:
                return "noticed"
            is_named = any(part in suspect for part in self.named for suspect in found.suspects)
            return "named" if is_named else "another"
        if found.verdict == "something is wrong":
            return "noticed"
        if found.verdict == "can't tell":
            return "can't tell"
        if self.mistake == "right":
            return "right"
        said = (*found.unseen, *found.notes)
        if any(part in text for part in self.named for text in said):
            return "said unseen"
        if self.effect_px <= found.error_px + 0.002:
            return "within its error"
        return "within its noise" if self.effect_px < found.best_px else "passed"


def cells(seeds: dict[str, int] | int, sources=None, mistakes=None) -> Iterator[Cell]:
    """Yields all cells of a number of seeds (by source), the right ones first."""
    every = (
        {"right": (lambda shots: shots, ())}
        | LISTED
        | {n: (m, ("steps",) if "steps" in n else ()) for n, m in UNLISTED.items()}
    )
    for source, make in (RECORDINGS | ENVS).items():
        count = seeds if isinstance(seeds, int) else seeds[source]
        for seed in range(count) if sources is None or source in sources else []:
            shots = make(seed)
            if shots is None:
                continue
            stored = shots if shots.flow is not None else with_estimated_flow(shots)
            least = left_px(stored)
            for name, (mistake, named) in every.items():
                if mistakes is not None and name not in mistakes:
                    continue
                of_flow = name.startswith("flow") or "flow" in name
                if source in ENVS and of_flow:
                    continue  # an env's raw flow is computed from its motions
                of_pictures = name in ("lens distortion", "K that changes")
                # Without flow of its own it is estimated, unless it is flow that is wrong.
                wrong = mistake(stored if of_flow else shots)
                found = of_env(wrong) if source in ENVS else of_recording(wrong)
                judged = wrong if wrong.flow is not None else (
                    with_estimated_flow(wrong) if of_pictures else wrong.with_(flow=stored.flow[: len(wrong.depth)])
                )  # fmt: skip
                px = left_px(judged)
                effect_px = float(np.sqrt(max(px**2 - least**2, 0.0)))
                yield Cell(source, seed, name, found, named, effect_px)
