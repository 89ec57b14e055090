"""How often flowrep's diagnosis is right: data drawn by seed, right and with a mistake in them.

    python benchmarks/diagnosis.py --seeds 0 60

prints rates with Wilson's intervals of 95 %. Seeds below 10,000 are for developing; what is
reported comes from seeds that nobody looked at.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.mistakes import LISTED, TWO, drawn
from benchmarks.shots import Array, Shots, draw, flow_of, frames_of

# Words by which a diagnosis says that mistakes with these names may be hidden.
ADMITTED = {
    "bodies": "bodies are not tested",
    "depth wrapped": "or depth is wrong there",
    "poses that freeze": "hardly anything moves",
}


def examined(
    shots: Shots, conventions: dict[str, str] | None = None, *, of_flow: bool = True
) -> Any:
    """Returns the diagnosis of a recording; its flow is estimated if there are pictures."""
    from flowrep.diagnosis import Examination

    is_recorded = of_flow and shots.rgb is None
    frames, found = (
        frames_of(shots, has_flow=is_recorded),
        Examination(conventions or {}, is_recorded),
    )
    poses = [None, *(frame.world_from_cam for frame in frames), None]
    for t, (previous, current) in enumerate(pairwise(frames)):
        found.add(previous, current, shots.flow[t + 1].astype(np.float32), poses[t], poses[t + 3])
    return found.diagnosis()


def tensordict_of(shots: Shots) -> tuple[TensorDict, torch.Tensor]:
    """Returns shots as an env and flowrep's transforms give them, and K."""
    from flowrep import geometry

    depth = torch.from_numpy(shots.depth.copy()).float().unsqueeze(1)
    ids = torch.from_numpy(shots.ids.copy()).long().unsqueeze(1)
    rows, K = rows_of(shots), torch.from_numpy(shots.K[0]).float()
    motion = torch.from_numpy(rows[:, 0]).float()
    if shots.row_0 is not None:
        rows = np.concatenate([shots.row_0[:, None], rows[:, 1:]], 1)
    rows = torch.from_numpy(rows).float()
    sensor = {"depth": depth, "instance": ids, "prev_from_curr": motion, "instance_motion": rows}
    sensor["world_from_cam"] = torch.from_numpy(shots.poses.copy())
    raw = geometry.rigid_flow(depth, ids, K, rows)
    parts = geometry.factorize(raw, depth, K, motion)
    flows = {"raw": raw.flow, "raw_valid": raw.valid, "ego": parts.ego, "obj": parts.obj}
    return TensorDict({"sensor": sensor, **flows}, [len(depth)]), K


def rows_of(shots: Shots) -> Array:
    """Returns `instance_motion`, [T, 1 + N, 4, 4]."""
    back = np.linalg.inv(np.concatenate([shots.poses[:1], shots.poses[:-1]]))
    return back[:, None] @ shots.moved @ shots.poses[:, None]


def found_of(shots: Shots) -> Any:
    from flowrep import diagnose

    return diagnose(*tensordict_of(shots)) if shots.is_env else examined(shots)


def effect_px(right: Shots, wrong: Shots) -> tuple[float, float]:
    """Returns how far a mistake moves ego or object flow, and the median length of flow, px."""
    moved, lengths = [], []
    rows = (
        [rows_of(each) for each in (right, wrong)] if right.is_env and right.ids is not None else []
    )
    for t in range(1, min(len(right.depth), len(wrong.depth))):
        both = [flow_of(each, t) for each in (right, wrong)]
        raw = right.flow[t]
        lengths.append(np.linalg.norm(raw, axis=0))
        change = [np.linalg.norm(both[1] - both[0], axis=0)]
        if rows:
            bodies = [flow_of(s, t, r[t][s.ids[t].ravel()]) for s, r in zip((right, wrong), rows)]
            on = right.ids[t] > 0
            change.append(np.where(on, np.linalg.norm(bodies[1] - bodies[0], axis=0), np.nan))
        else:
            change.append(np.linalg.norm((wrong.flow[t] - both[1]) - (raw - both[0]), axis=0))
        moved.append(change)
    known = [np.concatenate([x.ravel() for x in each]) for each in zip(*moved)]
    known = [np.where(np.isnan(x), np.inf if i == 0 else np.nan, x) for i, x in enumerate(known)]
    px = [float(np.nanmedian(x)) if np.isfinite(x).any() else 0.0 for x in known]
    return max(min(x, 1e4) for x in px), float(
        np.nanmedian(np.concatenate([x.ravel() for x in lengths]))
    )


def outcome(
    right: Shots, name: str, wanted: tuple[str, ...], wrong: Shots
) -> tuple[str, Any, float]:
    """Returns what came out, the diagnosis, and what the mistake changes, px."""
    found = found_of(wrong)
    if not name:
        return "called wrong" if found.is_wrong else found.verdict, found, 0.0
    px, flow_px = effect_px(right, wrong)
    if px <= max(0.05, 0.05 * flow_px):
        return "no effect", found, px
    if found.is_wrong:
        names = " ".join(found.suspects)
        if wanted and any(part in names for part in wanted):
            return "named", found, px
        return "misnamed" if found.verdict == "wrong" and names and wanted else "noticed", found, px
    if found.verdict == "can't tell":
        return "can't tell", found, px
    said = " ".join([*found.unseen, *found.notes])
    if "the camera hardly moves" in said:
        return "within", found, px
    wanted += tuple(words for start, words in ADMITTED.items() if name.startswith(start))
    if px <= 1.05 * (found.error_px + found.rough_px) or any(part in said for part in wanted):
        return "within", found, px
    return "passed", found, px


def with_least_shown(shots: Shots, seed: int) -> tuple[Shots, float]:
    """Returns shots whose motions have a common error, along what pictures show least, and its px.

    It is as long as up to 0.3 of the flow.
    """
    from flowrep.diagnosis import competition, envs, recordings
    from flowrep.diagnosis.fit import small_motion

    seen = []
    kept = competition.Competition

    class Kept(kept):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            seen.append(self)

    for module in (envs, recordings):
        module.Competition = Kept
    try:
        found_of(shots)
    finally:
        for module in (envs, recordings):
            module.Competition = kept
    if not seen:
        return shots, 0.0
    by = seen[0].recorded.poses.by
    least = torch.linalg.eigh(by.information.sum(0))[1][:, 0]
    step = torch.linalg.solve(by.root.mean(0), least)
    r = np.random.default_rng([72, seed])
    size = r.uniform(0.02, 0.3) * seen[0].flow_px * r.choice([-1, 1])
    D, poses = small_motion(size * step).numpy(), [shots.poses[0]]
    for before, now in pairwise(shots.poses):
        poses.append(poses[-1] @ D @ np.linalg.inv(before) @ now)
    wrong = shots.with_(poses=np.array(poses))
    return wrong, effect_px(shots, wrong)[0]


def power(seeds: range) -> None:
    """Prints how often an error that pictures show least is beyond what "right to within" says."""
    within = beyond = told = 0
    for seed in seeds:
        right = draw(seed, moving=0.0)
        wrong, px = with_least_shown(right, seed)
        found = found_of(wrong)
        told += not found.is_right
        within += found.is_right and px <= found.error_px
        beyond += found.is_right and px > found.error_px
        print(seed, ",".join(right.kind), f"{px:.3g} px", str(found).splitlines()[0], flush=True)
    print(
        f"right: the error is within x {wilson(within, within + beyond)}; told or can't tell: {told}"
    )


def wilson(count: int, total: int) -> str:
    if not total:
        return "none"
    p, z = count / total, 1.96
    middle, half = p + z * z / 2 / total, z * np.sqrt(p * (1 - p) / total + z * z / 4 / total**2)
    low, high = ((middle + sign * half) / (1 + z * z / total) for sign in (-1, 1))
    return f"{count:4d} of {total:4d} = {p:6.1%} ({max(low, 0):.1%} to {high:.1%})"


def cells(
    seeds: range, what: str = "both"
) -> Iterator[tuple[int, str, Shots, str, Any, float, float]]:
    """Yields seed, mistake ("" if right), shots, outcome, diagnosis, effect and seconds."""
    for seed in seeds:
        right, start = draw(seed), time.process_time()
        if what != "mistakes":
            kind, found, px = outcome(right, "", (), right)
            yield seed, "", right, kind, found, px, time.process_time() - start
        if what != "right":
            name, wanted, wrong = drawn(right, seed)
            start = time.process_time()
            kind, found, px = outcome(right, name, wanted, wrong)
            yield seed, name, right, kind, found, px, time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 10))
    parser.add_argument("--what", choices=["both", "right", "mistakes", "power"], default="both")
    parser.add_argument("--quiet", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.what == "power":
        return power(range(*args.seeds))
    rights, mistakes, kinds, seconds = Counter(), Counter(), Counter(), []
    for seed, name, shots, kind, found, px, spent in cells(range(*args.seeds), args.what):
        seconds.append(spent)
        route, share = shots.kind[2], "> 75 %" if shots.moving > 0.75 else "50 to 75 %"
        share = "< 50 % moving" if shots.moving < 0.5 else share
        if name:
            mistakes["listed" if name in {**LISTED, **TWO} else "unlisted", kind] += 1
            kinds[f"{name:32}", kind] += 1
        else:
            noise = "noisy poses" if "poses" in shots.kind else "exact poses"
            for group in ("all " + share, f"{route}, {shots.kind[3]}, {share}", f"{route}, {noise}, {share}",
                          f"{shots.kind[1]}, {share}"):  # fmt: skip
                rights[group, kind] += 1
        if not args.quiet:
            print(seed, f"{spent:.1f}s", ",".join(shots.kind), f"{shots.depth.shape[1:]} {shots.moving:.0%} |",
                  name or "right", "|", kind, f"| {px:.3g} px |", str(found).splitlines()[0][:230], flush=True)  # fmt: skip
    for group in sorted({group for group, _ in rights}):
        total = sum(n for (g, _), n in rights.items() if g == group)
        line = [
            f"{kind}: {wilson(rights[group, kind], total)}"
            for kind in ("called wrong", "can't tell")
        ]
        print(f"{group:44}", "; ".join(line))
    for group in ("listed", "unlisted"):
        total = sum(n for (g, kind), n in mistakes.items() if g == group and kind != "no effect")
        for kind in ("named", "noticed", "misnamed", "can't tell", "within", "passed"):
            print(f"{group} mistakes {kind:12} {wilson(mistakes[group, kind], total)}")
    for name in sorted({name for name, _ in kinds}):
        print("  ", name, {kind: n for (m, kind), n in kinds.items() if m == name})
    print(
        f"{len(seconds)} diagnoses, {np.mean(seconds):.2f} s each (process time), at most {max(seconds):.2f}"
    )


if __name__ == "__main__":
    main()
