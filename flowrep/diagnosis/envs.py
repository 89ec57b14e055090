"""The diagnosis of an env's rollout or of a replay batch."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from flowrep import geometry
from flowrep.diagnosis import fit, limits, recordings
from flowrep.diagnosis.competition import Competition
from flowrep.diagnosis.fit import (
    EYE,
    Pairs,
    length,
    middle,
    residuals,
    seen_before,
)
from flowrep.diagnosis.mistakes import mistakes_of
from flowrep.diagnosis.verdict import Diagnosis, judged

_ADAPTERS = {
    "pose_layout": "AdaptPose", "pose_direction": "AdaptPose", "pose_axes": "AdaptPose",
    "depth_kind": "AdaptDepth", "near_m": "AdaptDepth", "far_m": "AdaptDepth",
    "baseline_m": "AdaptDepth",
    "flow_direction": "AdaptFlow", "flow_channels": "AdaptFlow",
}  # fmt: skip
"""Options of recordings, and the transform that has each as an argument."""


@torch.no_grad()
def diagnose(
    frames: TensorDictBase, intrinsics: Any = None, *, raw_key: str = "raw", ego_key: str = "ego",
    obj_key: str = "obj",
) -> Diagnosis:  # fmt: skip
    """Returns the diagnosis of an env's rollout or of a replay batch.

    The reference is raw flow if it was measured, else the depth of the previous frame: raw flow
    that comes from recorded motions agrees with them even if they are wrong. What transforms wrote
    is computed again from what they read.

    Args:
        frames: successive frames `[*B, T]`, or steps `[*B]` in any order with their "next". Holds
            `("sensor", "depth")` and `("sensor", "prev_from_curr")`, and, where the env has them,
            instance, instance_motion, world_from_cam, rgb, and raw, ego and obj in px per step.
        intrinsics: K `[3, 3]` of the maps; None takes each frame's, `("sensor", "K")`.
        raw_key: the key of raw flow, as `ego_key` and `obj_key` of its parts.

    Raises:
        ValueError: there are no successive frames, no depth or no motions, or K is no camera's.

    >>> from tensordict import TensorDict
    >>> K = torch.tensor([[50.0, 0.0, 30.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]])
    >>> x, y = (torch.arange(60) - 29.5) / 50, (torch.arange(40)[:, None] - 19.5) / 50
    >>> near = (y / 0.4).maximum(-x / 0.6)  # the inverse depth of the floor and of a wall beside
    >>> inverse = [near.maximum((1 + x / 2) / (4 - 0.1 * t)) for t in range(16)]  # a wall ahead
    >>> depth = torch.stack(inverse)[:, None].reciprocal()
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[2, 3] = 0.1  # the camera moves ahead
    >>> sensor = {"depth": depth, "prev_from_curr": prev_from_curr.repeat(16, 1, 1)}
    >>> diagnose(TensorDict({"sensor": sensor}, [16]), K).verdict
    'right'
    """
    now, before, earlier, later = _successive(frames)
    K, prev_K = (_intrinsics(x, intrinsics) for x in (now, before))
    kept = _motion(now).isfinite().flatten(1).all(1).nonzero()[:, 0]
    if not len(kept):
        return recordings.no_diagnosis(["no camera motion between two frames is known"])
    kept = kept[_spread(len(kept), 2 * limits.PAIRS)]
    seen = _Seen(now[kept], before[kept], K[kept], prev_K[kept], raw_key)
    if bool((seen.depth < 0).double().mean() > 0.5):
        why = "depth is negative: give its opposite"
        return Diagnosis("wrong", why, suspects=("depth times -1",))
    first, second = EYE.expand_as(seen.motion), seen.motion
    if is_absolute := seen.poses is not None:
        first, second = seen.poses
    path = [first @ torch.linalg.inv_ex(earlier[kept])[0], first, second, second @ later[kept]]
    static = torch.where(seen.is_static, seen.depth, math.nan).squeeze(1)
    raw, picture = None, None
    if is_measured := not seen.is_derived:
        raw, picture = seen.raw, seen.now["sensor"].get("rgb", None)
    before = torch.where(seen.was_static[:, 0], seen.before, math.nan)
    maps = (static, before, seen.K, seen.prev_K, torch.stack(path, 1), picture)
    pairs = fit.sampled(raw, *maps)
    reasons = recordings.reasons_untestable(pairs)
    used = recordings.tested(reasons)
    if not used:
        return recordings.no_diagnosis(reasons)
    testable = torch.tensor(used)[_spread(len(used), limits.PAIRS)]
    mistakes = mistakes_of({}, by_flow=is_measured, of_flow=is_measured, absolute=is_absolute)
    names = [str(index) for index in kept[testable].tolist()]
    result = judged(Competition(pairs.select(testable), mistakes), names, _adapter_call)
    faults, odd = _recomputed(seen, ego_key, obj_key)
    kind, of_bodies = ("", "") if result.is_wrong else _bodies(seen, result.left_px)
    odd += recordings.note_on_untested(reasons)
    odd += [of_bodies] * (kind == "untested")
    result = replace(result, notes=(*result.notes, *odd))
    if faults := [*faults, *[of_bodies] * (kind == "fault")]:
        words = "; ".join([result.words, *faults] if result.is_wrong else faults)
        verdict = result.verdict if result.is_wrong else "wrong"
        return replace(result, verdict=verdict, words=words)
    return result


def _rounded_px(size: Any) -> Any:
    """Returns how far flow that is computed twice may differ, px, given its length."""
    return 2 * (limits.ROUNDED[0] + limits.ROUNDED[1] * size)


def _spread(count: int, most: int) -> Tensor:
    return torch.linspace(0, count - 1, min(count, most)).long()


def _intrinsics(frames: TensorDictBase, given: Any) -> Tensor:
    K: Tensor | None = frames.get(("sensor", "K"), None)
    if given is not None:
        K = torch.as_tensor(given).float()
    if K is None or (given is not None and K.shape != (3, 3)):
        got = "none" if K is None else list(K.shape)
        raise ValueError(f'K must be [3, 3], or each frame\'s in ("sensor", "K"); got {got}')
    geometry.check_intrinsics("K", K)
    return K.float().expand(len(frames), 3, 3)


def _motion(frames: TensorDictBase) -> Tensor:
    motion, rows = (frames.get(("sensor", k), None) for k in ("prev_from_curr", "instance_motion"))
    if motion is None and rows is None:
        raise ValueError('frames lack ("sensor", "prev_from_curr")')
    return (rows[..., 0, :, :] if motion is None else motion).double()


def _successive(frames: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase, Tensor, Tensor]:
    """Returns frames, those before them, and the motions before and after, nan where unknown."""
    if frames.get(("sensor", "depth"), None) is None:
        raise ValueError('frames lack ("sensor", "depth"), which make_env(keep_sensor=True) keeps')
    if 0 in frames.shape:
        raise ValueError(f"there are no successive frames in a batch of {list(frames.shape)}")
    if frames.get(("next", "sensor", "depth"), None) is not None:
        frames = frames if frames.ndim else frames.unsqueeze(0)
        before, now = frames.exclude("next"), frames["next"]
        # A step that begins with the depth that the one before ended with goes on from there.
        depths = (x["sensor", "depth"].flatten(now.ndim) for x in (before[..., 1:], now[..., :-1]))
        goes_on = torch.stack([z.nan_to_num(-1.0) for z in depths]).diff(dim=0)[0] == 0
        kept, goes_on = torch.ones(now.shape, dtype=torch.bool), goes_on.all(-1)
    else:
        if frames.ndim == 0 or frames.shape[-1] < 2:
            raise ValueError(f"frames have to be successive, [*B, T]; got {list(frames.shape)}")
        before, now = frames[..., :-1], frames[..., 1:]
        done = frames.get("done", torch.zeros(*frames.shape, 1, dtype=torch.bool))
        ended = frames.get(("next", "done"), done).squeeze(-1)
        kept, goes_on = ~ended[..., :-1], ~ended[..., 1:-1]
    motion, later = _motion(now), torch.full_like(_motion(now), math.nan)
    later[..., :-1, :, :] = torch.where(goes_on[..., None, None], motion[..., 1:, :, :], math.nan)
    kept = kept.flatten()
    motions = (x.reshape(-1, 4, 4)[kept] for x in (_motion(before), later))
    return now.reshape(-1)[kept], before.reshape(-1)[kept], *motions


class _Seen:
    """What an env recorded of P frames and of the previous ones, and the flow that follows."""

    def __init__(self, now: Any, previous: Any, K: Tensor, prev_K: Tensor, raw_key: str) -> None:
        self.now, self.K, self.prev_K, self.motion = now, K.double(), prev_K.double(), _motion(now)
        both = now["sensor"], previous["sensor"]
        self.depth, self.before = both[0]["depth"].double(), both[1]["depth"][:, 0].double()
        nobody = torch.zeros_like(self.depth, dtype=torch.long)
        self.ids, self.ids_before = (x.get("instance", nobody).long() for x in both)
        poses = [x.get("world_from_cam", None) for x in both[::-1]]
        self.poses = None if poses[0] is None else [pose.double() for pose in poses]
        rows, self.has_rows = self.motion.unsqueeze(1), "instance_motion" in both[0].keys()
        self.rows = both[0]["instance_motion"].double() if self.has_rows else rows
        rows = self.ids.clamp(0, self.rows.shape[1] - 1)
        # Many simulators number what stands still, too.
        stands = (self.rows - self.rows[:, :1]).abs().flatten(2).amax(-1) < 1e-6
        before = self.ids_before.clamp(0, self.rows.shape[1] - 1)
        self.is_static, self.was_static = (
            stands.gather(1, ids.flatten(1)).view_as(ids) for ids in (rows, before)
        )
        is_world = (self.ids == 0) & self.depth.isfinite()
        if not self.has_rows and is_world.double().mean() > limits.MANY:
            self.is_static, self.was_static = self.ids == 0, self.ids_before == 0
        self.flow = geometry.rigid_flow(self.depth, rows, self.K, self.rows, prev_K=self.prev_K)
        self.ego = self.flow_of(self.motion)
        self.raw, self.is_derived = now.get(raw_key, None), True
        if self.raw is not None:
            valid = now.get(f"{raw_key}_valid", torch.ones_like(self.flow.valid))
            self.raw = torch.where(valid, self.raw.double(), math.nan)
            expected = torch.where(self.flow.valid, self.flow.flow, math.nan)
            apart, size = (length(x.flatten(2)) for x in (self.raw - expected, expected))
            differs = (apart > _rounded_px(size))[apart.isfinite()]
            self.is_derived = not differs.double().mean() > limits.MANY

    def flow_of(self, motion: Tensor) -> geometry.Flow:
        """Returns the flow of a static world."""
        return geometry.ego_flow(self.depth, self.K, motion.double(), prev_K=self.prev_K)


def _recomputed(seen: _Seen, ego_key: str, obj_key: str) -> tuple[list[str], list[str]]:
    """Returns what is wrong with what an env or its transforms computed, and what is odd."""
    faults, odd, ego = [], [], torch.where(seen.ego.valid, seen.ego.flow, math.nan)
    of_poses, raw = ego, seen.flow.flow if seen.raw is None else seen.raw
    if seen.poses is not None:
        of_poses = seen.flow_of(geometry.relative_motion(*seen.poses, dtype=torch.float64)).flow
    for description, given, right in (
        ("row 0 of instance_motion isn't prev_from_curr", seen.flow_of(seen.rows[:, 0]).flow, ego),
        ("prev_from_curr isn't the motion of world_from_cam", ego, of_poses),
        (f"{ego_key} isn't the flow of depth, K and prev_from_curr", seen.now.get(ego_key), ego),
        (f"{obj_key} isn't raw flow without ego flow", seen.now.get(obj_key), raw - ego),
    ):
        if given is None:
            continue
        right, given = (x.double().movedim(1, -1).flatten(0, -2) for x in (right, given))
        counts = (right.norm(dim=-1) > 0.05) & right.isfinite().all(-1) & given.isfinite().all(-1)
        if counts.sum() < 0.01 * counts.numel():
            continue
        right, given = right[counts], given[counts]
        factor = float((given * right).sum() / right.square().sum())
        px, as_factor_px, size_px = (
            float(x.norm(dim=-1).median()) for x in (given - right, given - factor * right, right)
        )
        if px <= _rounded_px(size_px):
            continue
        if 1e-3 < factor < 1e3 and as_factor_px < px / 20:
            odd.append(f"{description}, but {factor:.3g} times that (a scale, or px/s)")
        elif px < limits.MOST_NOISE * size_px:
            odd.append(f"{description} ({px:.2g} px off), as if one had noise")
        else:
            faults.append(f"{description} ({px:.2g} px off)")
    return faults, odd


def _bodies(seen: _Seen, world_px: float) -> tuple[str, str]:
    """Returns "fault", "untested" or "" of bodies' ids and motions, and the reason.

    Each body of each frame is judged as the camera is, by its pixels and the depth before. The
    world's residual `world_px`, of the camera's poses, is no fault of a body's.
    """
    count, ids = seen.rows.shape[1], seen.ids[:, 0]
    unseen = "moving bodies are hardly seen: ids and motions of bodies are not tested"
    if not seen.has_rows:
        return "untested", unseen
    if int(ids.min()) < 0 or int(ids.max()) >= count:
        given = f"{int(ids.min())} to {int(ids.max())}"
        return "fault", f"instance has ids {given}, but instance_motion rows 0 to {count - 1}"
    moved = (seen.rows - seen.motion.unsqueeze(1)).abs().flatten(2).amax(-1) > 1e-4
    moving = moved.any(0).nonzero()[:, 0].tolist()  # rows that are nan don't count
    if moving and not (ids > 0).any():
        which = f"{moving[0]} to {moving[-1]}"
        return "untested", f"bodies {which} move, but no pixel of instance has their ids"
    known = torch.where(seen.depth[:, 0].isfinite() & (ids > 0), ids, 0)
    sizes = functional.one_hot(known.flatten(1), count).sum(1)
    body, frame = (sizes.T[1:] >= limits.FEW_PIXELS).nonzero().T
    if not len(body):
        return "untested", unseen
    chosen = _spread(len(frame), 2 * limits.PAIRS)
    frame, body = frame[chosen], body[chosen] + 1
    of_body = body[:, None, None]
    depth = torch.where(known[frame] == of_body, seen.depth[frame, 0], math.nan)
    before, nearest = seen.before[frame], depth.nan_to_num(math.inf).amin((1, 2), keepdim=True)
    is_body = seen.ids_before[frame, 0] == of_body
    # Depth is unknown between a body's edge and the next pixel, and where something hides the body.
    around = functional.max_pool2d(is_body.float(), 3, 1, 1) > 0
    other = torch.where(around | (before < 0.9 * nearest), math.nan, math.inf)
    before = torch.where(is_body, before, other)
    first = EYE.expand(len(frame), 4, 4)
    path = torch.stack([first, first, seen.rows[frame, body], first], 1)
    pairs = fit.sampled(None, depth, before, seen.K[frame], seen.prev_K[frame], path)
    still = seen.motion[frame]
    at, at_rest = (seen_before(pairs, motion)[0] for motion in (pairs.motion, still))
    residuals_px = residuals(pairs, pairs.motion)
    moved_px, residual_px = middle(at - at_rest), middle(residuals_px)
    number = residuals_px.isfinite().sum((1, 2))
    testable = torch.maximum(moved_px, residual_px) >= limits.REST_PX
    testable &= number >= limits.FEW_PIXELS
    if int(testable.sum()) < limits.FEW:
        return "untested", unseen
    names = [f"body {i}" for i in body[testable].tolist()]
    found = judged(Competition(pairs.select(testable), []), names, _adapter_call)
    px, share = limits.HARMLESS
    if found.is_wrong and found.left_px > world_px + px + share * found.raw_px:
        left = f"{found.left_px:.2g} px are left, {found.best_px:.2g} px by other motions"
        return "fault", f"on bodies, ids, instance_motion, depth and K don't fit: {left}"
    if not found.is_right:
        return "untested", f"motions of bodies are not tested: {found.words}"
    return "", ""


def _adapter_call(remedy: str, _: Pairs) -> str:
    """Returns the call of the adapter that has these options; other texts are unchanged."""
    options = dict(option.partition("=")[::2] for option in remedy.split(" "))
    if not options.keys() <= _ADAPTERS.keys():
        return remedy
    adapter = _ADAPTERS[next(iter(options))]
    if adapter == "AdaptFlow":  # it has no defaults
        options = {"flow_direction": "forward", "flow_grid": "current"} | options
    arguments = [
        f"{key}={value}" if key.endswith("_m") else f'{key.partition("_")[2]}="{value}"'
        for key, value in options.items()
    ]
    if options.get("depth_kind") in ("ray_length", "disparity"):
        arguments.append("intrinsics=K")
    return f"{adapter}({', '.join(arguments)})"
