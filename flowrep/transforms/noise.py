"""Noise of real sensors on depth, camera motion and flow: drawn anew, or fixed for each frame."""

from __future__ import annotations

import math
import multiprocessing
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from flowrep.geometry.checks import checked_count, checked_number
from flowrep.geometry.pose import rotation_from_vector
from flowrep.transforms import base
from flowrep.transforms.base import Keys, MapTransform, Reads, as_keys, check_choice
from flowrep.transforms.flow import masked_flow

FRAME = Reads(("F",), "integer")


class _Sensor(NamedTuple):
    reads: Reads
    key: NestedKey
    options: tuple[str, ...]


NOISY_SENSORS = {
    "depth": _Sensor(base.DEPTH, ("sensor", "depth"), ("depth_sigma_per_m", "depth_dropout")),
    "motion": _Sensor(base.MOTION, ("sensor", "prev_from_curr"), ("drift_m", "drift_rad")),
    "flow": _Sensor(base.FLOW, "raw", ("flow_sigma_px",)),
}

# SplitMix64's constants as signed integers, since torch has no arithmetic on uint64; products wrap
# around as they should.
_GAMMA, _FIRST, _SECOND = (
    number - (1 << 64) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
_DIGITS = 24  # bits of a float32's significand; `normal` and `uniform` use 24 of the 64 bits each


class SensorNoise(MapTransform):
    """Adds real sensors' noise to depth, camera motion and flow; by default none.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")` | the same, noisy | float `[*B, 1, H, W]` | > 0, inf, nan | m |
    | `("sensor", "prev_from_curr")` | the same, noisy | float `[*B, 4, 4]` | rigid | m |
    | `"raw"` if chosen | the same, noisy | float `[*B, 2, H, W]` | any | px/step |
    | `frame_key` if given | | integer `[*B, F]` | | |

    Convention: depth z gets a normal error of standard deviation `depth_sigma_per_m` · z², as with
    stereo and structured light. Depth that is no longer positive becomes a hole (`nan`), and so
    does each pixel with probability `depth_dropout`. Camera motion is followed by a small rigid
    motion of the current camera, so that integrated poses drift as odometry does. A sensor with all
    of its options at 0 passes through bitwise unchanged.

    Put it into the env, after `RawFlow` and before `FlowFactorize`, so that stored samples hold
    what the agent saw. The frames of resets get noise like all others.

    With `frame_key`, noise is a function of the integers that identify a frame, e.g. episode and
    step. A frame gets the same noise in any batch, order, process or session, at the root and under
    `"next"`, and there is no state to save.

    Without it, each call draws new noise. On a replay buffer that is augmentation: the root and
    `"next"` get independent errors. The calls so far are counted in `state_dict`, so that a resumed
    run continues the sequence. The envs of a `SerialEnv` or `ParallelEnv` draw independent noise
    unless all get the same seed, or are copies of an env that has been used.

    Args:
        sensors: which of `"depth"`, `"motion"` and `"flow"` to read and write.
        depth_sigma_per_m: standard deviation of depth over z², 1/m; about 0.002 for a depth camera.
        depth_dropout: probability that a pixel's depth is missing.
        drift_m: standard deviation per step of the motion's translation along each axis, metres.
        drift_rad: standard deviation per step of its rotation about each axis, radians.
        flow_sigma_px: standard deviation of each flow channel, pixels per step.
        seed: envs with the same seed have the same noise. None draws one from torch's global
            generator (`torch.manual_seed` makes it reproducible), and adds the name of the worker
            process; with `frame_key`, None is 0.
        frame_key: key of the integers that identify the frame, such as StreetEnv's
            `("sensor", "frame")`.
        in_keys: one key for each sensor; the table's by default.
        out_keys: one key for each sensor; `in_keys` by default.

    Raises:
        ValueError: an option is negative or not finite, or its sensor isn't among `sensors`.

    Example:
        >>> from tensordict import TensorDict
        >>> depth = torch.tensor([[[1.0, 10.0, torch.inf]]])
        >>> noise = SensorNoise(sensors=["depth"], depth_sigma_per_m=0.01)
        >>> error = noise(TensorDict({"sensor": {"depth": depth}}))["sensor", "depth"] - depth
        >>> bool(error[..., 0].abs() < 0.05), bool(error[..., 1].abs() < 5.0)
        (True, True)
    """

    # What distinguishes calls without frames: a number drawn, and the count of calls.
    drawn_and_calls: Tensor | None

    def __init__(
        self,
        *,
        sensors: Sequence[str] = ("depth", "motion"),
        depth_sigma_per_m: float = 0.0,
        depth_dropout: float = 0.0,
        drift_m: float = 0.0,
        drift_rad: float = 0.0,
        flow_sigma_px: float = 0.0,
        seed: int | None = None,
        frame_key: NestedKey | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        options = {
            "depth_sigma_per_m": depth_sigma_per_m,
            "depth_dropout": depth_dropout,
            "drift_m": drift_m,
            "drift_rad": drift_rad,
            "flow_sigma_px": flow_sigma_px,
        }
        check_choice("sensors", sensors, NOISY_SENSORS)
        for name, value in options.items():
            checked_number(name, value, "a finite number of at least 0", lambda x: x >= 0)
            (sensor,) = (each for each, x in NOISY_SENSORS.items() if name in x.options)
            if value and sensor not in sensors:
                raise ValueError(f"{name} needs {sensor!r} among sensors, got {list(sensors)}")
        if depth_dropout > 1.0:
            raise ValueError(f"depth_dropout must be a probability, got {depth_dropout}")
        read = (
            [NOISY_SENSORS[name].key for name in sensors] if in_keys is None else as_keys(in_keys)
        )
        frame = [] if frame_key is None else as_keys([frame_key])
        super().__init__(
            [NOISY_SENSORS[name].reads for name in sensors] + [FRAME] * len(frame),
            read + frame,
            read if out_keys is None else out_keys,
            writes=len(sensors),
        )
        self.sensors, self.options = tuple(sensors), options
        self.seed = None if seed is None else checked_count("seed", seed, 0)
        state = None if frame else torch.zeros(2, dtype=torch.int64)
        if state is not None and seed is None:
            state[0] = torch.randint(2**62, ())
        self.register_buffer("drawn_and_calls", state)

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        maps = super()._tensors(tensordict)
        for i, (sensor, key) in enumerate(zip(self.sensors, self.in_keys)):
            if sensor == "flow" and self.out_keys[i] != key:  # the mask lies beside the read key
                maps[i] = masked_flow(maps[i], key, tensordict)
        return maps

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the sensors' maps with noise; with `frame_key`, frames are the last map."""
        state = self.drawn_and_calls
        batch = maps[0].shape[: maps[0].ndim - len(self.reads[0].shape)]
        frame = maps[-1] if state is None else self._next_frames(state, batch, maps[0].device)
        return tuple(self._noisy(sensor, x, frame) for sensor, x in zip(self.sensors, maps))

    def _noisy(self, sensor: str, value: Tensor, frame: Tensor) -> Tensor:
        options = [self.options[name] for name in NOISY_SENSORS[sensor].options]
        if not any(options):
            return value
        shape = (6,) if sensor == "motion" else tuple(value.shape[frame.ndim - 1 :])
        stream = list(NOISY_SENSORS).index(sensor)
        bits = frame_bits(frame, shape, seed=self.seed or 0, stream=stream)
        normals = normal(bits).to(value.dtype)
        if sensor == "depth":
            sigma, dropout = options
            return noisy_depth(value, normals, uniform(bits), sigma_per_m=sigma, dropout=dropout)
        if sensor == "motion":
            return drifted_motion(value, normals, drift_m=options[0], drift_rad=options[1])
        return value + options[0] * normals

    def _next_frames(self, state: Tensor, batch: Sequence[int], device: torch.device) -> Tensor:
        """Returns integers `[*B, 3]` that no other call has: what was drawn, the call, the row."""
        drawn, calls = state.to(device).unbind()
        if self.seed is None:  # at the first call, which a worker makes in its process
            drawn = torch.where(calls == 0, drawn ^ _number_of_process(), drawn)
        rows = torch.arange(math.prod(batch), device=device).reshape(batch)
        frames = torch.stack([drawn.expand(batch), calls.expand(batch), rows], -1)
        following = torch.stack([drawn, calls + 1])
        if torch.compiler.is_exporting():  # a program has a buffer of its own, and counts in it
            state.copy_(following)
        else:  # copies of the transform, such as TorchRL's shallow clones, have it in common
            self.drawn_and_calls = following
        return frames

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns unbounded specs, as errors are unbounded."""
        seen = specs[: len(self.out_keys)]  # without the frame's
        return tuple(Unbounded(s.shape, device=s.device, dtype=s.dtype) for s in seen)


@torch.compiler.assume_constant_result
def _number_of_process() -> int:
    """Returns a number that differs between worker processes."""
    # Forked workers share the state of torch's generator, spawned ones its default seed: only their
    # names differ.
    return zlib.crc32(multiprocessing.current_process().name.encode())


def noisy_depth(
    depth: Tensor, normal: Tensor, uniform: Tensor, *, sigma_per_m: float, dropout: float
) -> Tensor:
    """Returns depth `[*B, 1, H, W]` with an error of sigma_per_m · z², and holes (nan).

    `normal` and `uniform` hold standard normal numbers and ones in [0, 1), of depth's shape. Depth
    inf stays inf unless it drops out.
    """
    near = torch.where(depth.isinf(), 0.0, depth)
    noisy = torch.where(depth.isinf(), depth, near + sigma_per_m * near.square() * normal)
    return torch.where((noisy > 0.0) & (uniform >= dropout), noisy, math.nan)


def drifted_motion(
    prev_from_curr: Tensor, normal: Tensor, *, drift_m: float, drift_rad: float
) -> Tensor:
    """Returns the rigid motion `[*B, 4, 4]` of a slightly displaced current camera.

    `normal` holds standard normal numbers `[*B, 6]`: translation, then rotation vector.
    """
    shift, turn = normal.double().split([3, 3], -1)
    rotation = rotation_from_vector(drift_rad * turn)
    motion = prev_from_curr.double()
    turned = motion[..., :3, :3] @ rotation
    moved = motion[..., :3, 3:] + motion[..., :3, :3] @ (drift_m * shift).unsqueeze(-1)
    rigid = torch.cat([torch.cat([turned, moved], -1), motion[..., 3:, :]], -2)
    return rigid.to(prev_from_curr.dtype)


def split_mix(state: Tensor) -> Tensor:
    """Returns what SplitMix64 (Steele, Lea and Flood, 2014) generates from each state, int64."""
    z = state + _GAMMA
    for bits, factor in ((30, _FIRST), (27, _SECOND)):
        z ^= _shifted(z, bits)
        z *= factor
    z ^= _shifted(z, 31)
    return z


def frame_bits(frame: Tensor, shape: Sequence[int], *, seed: int, stream: int) -> Tensor:
    """Returns 64 random bits for each element, int64 `[*B, *shape]`, of frames `[*B, N]`.

    N integers identify a frame; `stream`, a small number, distinguishes its sensors.
    """
    start = torch.full_like(frame[..., 0], seed, dtype=torch.int64)
    for number in (torch.full_like(start, stream), *frame.long().unbind(-1)):
        start = split_mix(start) ^ number
    start = split_mix(start)
    element = torch.arange(math.prod(shape), device=frame.device)
    numbers = split_mix(start.unsqueeze(-1) + element * _GAMMA)
    return numbers.unflatten(-1, tuple(shape))


def normal(bits: Tensor) -> Tensor:
    """Returns standard normal numbers from the low bits, float32, within 5.5 of 0."""
    # An odd number over 2^24: exact in float32, symmetric about 0, never at an end of (-1, 1).
    odd = 2 * (bits & ((1 << _DIGITS) - 1)) + 1 - (1 << _DIGITS)
    return math.sqrt(2.0) * torch.erfinv(odd.float() * 2.0**-_DIGITS)


def uniform(bits: Tensor) -> Tensor:
    """Returns uniform numbers in [0, 1) from the high bits, float32; `normal` uses others."""
    return _shifted(bits, 64 - _DIGITS).float() * 2.0**-_DIGITS


def _shifted(z: Tensor, bits: int) -> Tensor:
    """Returns z shifted right and filled with zeros; torch's shift repeats the sign."""
    moved = z >> bits
    moved &= (1 << (64 - bits)) - 1
    return moved
