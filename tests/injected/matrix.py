"""What flowrep's diagnosis says of right data and of every mistake in them, cell by cell.

`python -m tests.injected.matrix [source ...]` writes the table in docs/diagnosis.md, or the columns
of these sources. A column takes a minute.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from flowrep import diagnose, geometry
from flowrep.diagnosis import Diagnosis, Examination
from flowrep.sequences import EstimatedFlowSource, Frame
from flowrep.transforms import DIS
from tests.injected.mistakes import LISTED, UNLISTED
from tests.injected.sources import ENVS, RECORDINGS, Shots, ego_flow, of_rows

PAGE = Path(__file__).parents[2] / "docs/diagnosis.md"
MARKS = "<!-- table -->\n", "<!-- end -->"
NOTES = {  # that say of a mistake of no table that it may be there
    "poses that freeze": "pairs are not tested",
    "depth in steps of 25 cm": "steps",
    "depth beyond 3 m wrapped": "pixels don't fit",
    "depth enlarged 4 times": "pixels don't fit",
}
NOTES |= {name: "motions of bodies are not tested" for name in UNLISTED if name[:6] == "bodies"}
KINDS = {  # what comes out of a cell, and what that means
    "right": "right data, called right",
    "named": "wrong, and the mistake is named",
    "noticed": "something is wrong, or, of a mistake that no table lists, what would correct it",
    "another": "wrong, but another mistake is named",
    "can't tell": "can't tell",
    "small": "called right; the mistake adds less than the error and the noise that are printed",
    "said": "called right; a note says that such a mistake may be there, or would not show",
    "passed": "**called right, without a word**",
    "false alarm": "**right data called wrong**",
}


def frames_of(shots: Shots, *, raw: bool) -> list[Frame]:
    frames = []
    for t, depth in enumerate(shots.depth):
        own = shots.flow[t].astype(np.float32) if raw else None
        rgb = None if shots.rgb is None else shots.rgb[t]
        poses, K, since = shots.poses[t].copy(), shots.K[t].copy(), f"{t - 1}" if t else None
        z = depth.astype(np.float32)
        frames.append(Frame(f"{t}", Path(f"{t}"), poses, K, z, rgb, t / 30, own, since))
    return frames


@cache
def estimator() -> EstimatedFlowSource:
    return EstimatedFlowSource(DIS("fast"))


def with_estimated_flow(shots: Shots) -> Shots:
    """Returns shots with DIS's flow, as if a user had stored it."""
    flow = [np.full((2, *shots.depth.shape[1:]), np.nan, np.float32)]
    flow += [estimator()(*both) for both in pairwise(frames_of(shots, raw=False))]
    return shots.with_(flow=np.array(flow))


def of_recording(shots: Shots) -> Diagnosis:
    """Returns the diagnosis of shots read as a recording."""
    is_recorded = shots.flow is not None
    frames, found = frames_of(shots, raw=is_recorded), Examination(flow_is_recorded=is_recorded)
    poses = [None, *(frame.world_from_cam for frame in frames), None]
    for t, (previous, current) in enumerate(pairwise(frames)):
        raw = current.raw if is_recorded else estimator()(previous, current)
        found.add(previous, current, raw, poses[t], poses[t + 3])
    return found.diagnosis()


def tensordict_of(shots: Shots) -> tuple[TensorDict, torch.Tensor]:
    """Returns shots as an env and flowrep's transforms give them, and K.

    Flow estimated from the pictures is beside them, under "estimated".
    """
    depth = torch.from_numpy(shots.depth.copy()).float().unsqueeze(1)
    ids = torch.zeros_like(depth, dtype=torch.long)
    if shots.ids is not None:
        ids = torch.from_numpy(shots.ids.copy()).long().unsqueeze(1)
    poses, K = torch.from_numpy(shots.poses.copy()), torch.from_numpy(shots.K[0]).float()
    prev_from_world = torch.linalg.inv(torch.cat([poses[:1], poses[:-1]]))
    motion = prev_from_world @ poses
    rows = motion.unsqueeze(1)
    if shots.moved is not None:
        bodies = prev_from_world[:, None] @ torch.from_numpy(shots.moved[:, 1:]) @ poses[:, None]
        rows = torch.cat([rows, bodies], 1)
    motion, rows = motion.float(), rows.float()
    sensor = {"depth": depth, "instance": ids, "prev_from_curr": motion, "instance_motion": rows}
    sensor["world_from_cam"] = poses
    raw = geometry.rigid_flow(depth, ids, K, rows)
    parts = geometry.factorize(raw, depth, K, motion)
    flows = {"raw": raw.flow, "raw_valid": raw.valid, "ego": parts.ego, "obj": parts.obj}
    return TensorDict({"sensor": sensor, **flows}, [len(depth)]), K


def of_env(shots: Shots, *, by_pictures: bool = False) -> Diagnosis:
    """Returns the diagnosis of shots as an env gives them, with flow of the pictures if asked."""
    frames, K = tensordict_of(shots)
    if not by_pictures:
        return diagnose(frames, K)
    frames["sensor", "rgb"] = torch.from_numpy(shots.rgb.copy()).permute(0, 3, 1, 2)
    frames["estimated"] = torch.from_numpy(with_estimated_flow(shots).flow).float()
    frames["estimated_obj"] = frames["estimated"] - frames["ego"]
    return diagnose(frames, K, raw_key="estimated", obj_key="estimated_obj")


def left_px(shots: Shots) -> float:
    """Returns the median of |raw - ego| by depth, K and poses as they are, by brute force."""
    left = [shots.flow[t] - ego_flow(shots, t) for t in range(1, len(shots.depth))]
    return float(np.nanmedian(np.linalg.norm(left, axis=1)))


def bodies_px(shots: Shots, wrong: Shots) -> float:
    """Returns the median difference of bodies' flow, 0 where none shows."""
    both = []
    for each in (shots, wrong):
        rows = [np.linalg.inv(each.poses[max(t - 1, 0)]) @ moved @ each.poses[t]
                for t, moved in enumerate(each.moved)]  # fmt: skip
        same = each.depth, each.poses, each.K[0], None, each.ids, np.array(rows)
        both.append(of_rows(*same).flow)
    differs = np.linalg.norm(both[0] - both[1], axis=1)[shots.ids > 0]
    return float(np.nanmedian(differs)) if np.isfinite(differs).any() else 0.0


@dataclass(frozen=True)
class Cell:
    """A mistake in a source. `effect_px` is what it adds to |raw - ego|."""

    source: str
    seed: int
    mistake: str
    found: Diagnosis
    named: tuple[str, ...]  # parts of the names that are wanted
    effect_px: float

    @property
    def kind(self) -> str:
        """Returns what came out, in the words of the docs' table."""
        found, is_right = self.found, self.mistake == "right"
        if found.is_wrong:
            if is_right:
                return "false alarm"
            names = " ".join(found.suspects)
            if self.mistake in UNLISTED or found.verdict == "something is wrong" or not names:
                return "noticed"
            return "named" if any(part in names for part in self.named) else "another"
        if found.verdict == "can't tell":
            return "can't tell"
        said = " ".join([*found.unseen, *found.notes])
        if is_right:
            return "right"
        if any(part in said for part in self.named):
            return "said"
        hidden_px = np.hypot(found.error_px, found.best_px)
        return "small" if self.effect_px <= 1.1 * hidden_px + 0.002 else "passed"


def cells(
    sources: Collection[str] | None = None, mistakes: Collection[str] | None = None, seeds: int = 1
) -> Iterator[Cell]:
    """Yields the cells of some sources and mistakes, of all by default, the right ones first."""
    right = {"right": (lambda shots: shots, ())}
    every = (
        right | LISTED | {name: (m, (NOTES.get(name, "steps"),)) for name, m in UNLISTED.items()}
    )
    for source, make in (RECORDINGS | ENVS).items():
        for seed in range(seeds) if sources is None or source in sources else []:
            if (shots := make(seed)) is None:
                continue
            stored = shots if shots.flow is not None else with_estimated_flow(shots)
            least = left_px(stored)
            for name, (mistake, named) in every.items():
                of_flow, of_pictures = "flow" in name, name in ("lens distortion", "K that changes")
                if mistakes is not None and name not in mistakes:
                    continue
                of_bodies = name.startswith("bodies")
                if of_bodies and (source not in ENVS or shots.moved.shape[1] < 2):
                    continue
                if source in ENVS and (of_flow or of_pictures):
                    continue  # an env computes its flow and draws with the K that it tells
                # Without flow of its own it is estimated, unless it is flow that is wrong.
                wrong = mistake(stored if of_flow else shots)
                if source in ENVS:
                    found = of_env(wrong, by_pictures=source.startswith("ViZDoom"))
                else:
                    found = of_recording(wrong)
                if wrong.flow is None:
                    same = wrong.with_(flow=stored.flow[: len(wrong.depth)])
                    wrong = with_estimated_flow(wrong) if of_pictures else same
                effect_px = np.sqrt(max(left_px(wrong) ** 2 - least**2, 0.0))
                if of_bodies:
                    effect_px = bodies_px(shots, wrong)
                yield Cell(source, seed, name, found, named, float(effect_px))


def table_of(page: str) -> dict[str, dict[str, str]]:
    """Returns the kinds that a page's table has, by mistake and source."""
    lines = page.partition(MARKS[0])[2].partition(MARKS[1])[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]
    return {row[0]: dict(zip(rows[0][1:], row[1:])) for row in rows[2:] if row[1:]}


def written(table: dict[str, dict[str, str]]) -> str:
    """Returns how often each kind came out, and the table as Markdown."""
    sources = [name for name in RECORDINGS | ENVS if any(name in row for row in table.values())]
    lines = [["mistake", *sources], ["---"] * (1 + len(sources))]
    lines += [[name, *(row.get(source, "") for source in sources)] for name, row in table.items()]
    counts = Counter(kind for row in table.values() for kind in row.values())
    mistakes = sum(counts[kind] for kind in KINDS) - counts["right"] - counts["false alarm"]
    as_right = sum(counts[kind] for kind in ("small", "said", "passed"))
    text = f"Of {mistakes} mistakes, {as_right} are called right. The cells:\n\n"
    text += "".join(f"- {kind}: {counts[kind]} ({KINDS[kind]})\n" for kind in KINDS)
    return text + "\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main(sources: list[str]) -> None:
    """Writes the columns of some sources, or of all."""
    torch.set_num_threads(1)
    page = PAGE.read_text("utf-8")
    table = {name: table_of(page).get(name, {}) for name in ("right", *LISTED, *UNLISTED)}
    for cell in cells(sources or None):
        table[cell.mistake][cell.source] = cell.kind
        said = f"{cell.source} | {cell.mistake} | {cell.kind} | {cell.effect_px:.3g} px"
        print(said, cell.found.words, sep=" | ", flush=True)
    start, end = page.index(MARKS[0]) + len(MARKS[0]), page.index(MARKS[1])
    PAGE.write_text(f"{page[:start]}\n{written(table)}{page[end:]}", "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
