"""Sensor noise: its size, its independence, and frames that keep theirs."""

import copy
import functools
import itertools
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv

from flowrep.geometry import check_rigid
from flowrep.transforms import SensorNoise
from flowrep.transforms.noise import (
    drifted_motion,
    frame_bits,
    noisy_depth,
    normal,
    split_mix,
    uniform,
)
from tests.transforms.fake_env import FakeSensorEnv

ALL = {
    "sensors": ["depth", "motion", "flow"], "depth_sigma_per_m": 0.01, "depth_dropout": 0.1,
    "drift_m": 0.02, "drift_rad": 0.03, "flow_sigma_px": 0.5,
}  # fmt: skip


def maps(count: int = 2) -> list[torch.Tensor]:
    depth = torch.linspace(1.0, 20.0, 12).reshape(1, 3, 4).repeat(count, 1, 1, 1)
    return [depth, torch.eye(4).repeat(count, 1, 1), torch.ones(count, 2, 3, 4)]


def test_depth_s_error_grows_with_its_square_by_hand():
    # z = 2 m and 10 m, 0.01 / m: 0.04 m and 1 m a standard deviation; 2 and -0.5 of them.
    depth = torch.tensor([2.0, 10.0, 10.0, 10.0, math.inf, math.nan, 0.5]).reshape(1, 1, 7)
    normal = torch.tensor([2.0, -0.5, 0.0, -11.0, 3.0, 0.0, -1.0]).reshape(1, 1, 7)
    uniform = torch.tensor([0.9, 0.3, 0.29, 0.9, 0.9, 0.9, 0.9]).reshape(1, 1, 7)
    noisy = noisy_depth(depth, normal, uniform, sigma_per_m=0.01, dropout=0.3).flatten()
    torch.testing.assert_close(noisy[:2], torch.tensor([2.08, 9.5]))
    assert noisy[2].isnan()  # dropped out: 0.29 < 0.3
    assert noisy[3].isnan()  # it would lie behind the camera
    assert noisy[4] == math.inf  # sky stays sky
    assert noisy[5].isnan()
    torch.testing.assert_close(noisy[6], torch.tensor(0.4975))


def test_drift_follows_the_motion_by_hand():
    # The current camera is taken for one 0.5 m ahead of it and turned by 90 degrees to the left
    # (about -y). The true motion: a quarter turn about z, 3 m along x.
    motion = torch.tensor([[0.0, -1, 0, 3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    normal = torch.tensor([0.0, 0.0, 5.0, 0.0, -1.0, 0.0])
    drifted = drifted_motion(motion, normal, drift_m=0.1, drift_rad=math.pi / 2)
    # Ahead (z) of the wrong camera is the true one's left, -x, which the motion turns to -y.
    ahead = drifted @ torch.tensor([0.0, 0.0, 1.0, 0.0])
    torch.testing.assert_close(ahead, torch.tensor([0.0, -1.0, 0.0, 0.0]), atol=1e-6, rtol=0)
    origin = drifted @ torch.tensor([0.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(origin, torch.tensor([3.0, 0.0, 0.5, 1.0]))
    far = drifted_motion(motion.double(), 3 * normal + 1, drift_m=3.0, drift_rad=1.0)
    check_rigid("motion", far, tolerance=1e-12)


def test_noise_has_the_size_that_was_asked_for():
    depth, motion, flow = maps(20_000)
    noisy_z, motions, noisy_flow = SensorNoise(**ALL).compute(0 * depth + 10.0, motion, flow)
    error = noisy_z[~noisy_z.isnan()] - 10.0
    assert abs(noisy_z.isnan().float().mean() - 0.1) < 0.004  # 240,000 pixels: 6 sigma
    assert abs(error.std() - 1.0) < 0.02
    assert abs(error.mean()) < 0.02
    assert abs(noisy_flow.std() - 0.5) < 0.01
    assert abs(motions[:, :3, 3].std() - 0.02) < 0.001
    assert abs(motions[:, 2, 1].std() - 0.03) < 0.001  # about x


def test_each_option_changes_its_own_sensor_alone():
    depth = dict.fromkeys(("depth_sigma_per_m", "depth_dropout"), 0)
    for option, changed in (depth | {"drift_m": 1, "drift_rad": 1, "flow_sigma_px": 2}).items():
        noise = SensorNoise(sensors=ALL["sensors"], **{option: 0.3})
        same = [torch.equal(got, want) for got, want in zip(noise.compute(*maps()), maps())]
        assert [i for i, equal in enumerate(same) if not equal] == [changed], option


def test_a_seed_gives_a_sequence_and_another_seed_or_torch_s_own_another():
    def sequence(torch_s: int, seed: int | None) -> torch.Tensor:
        torch.manual_seed(torch_s)
        noise = SensorNoise(**ALL, seed=seed)
        return torch.stack([noise.compute(*maps())[2] for _ in range(3)])

    first = sequence(5, 1)
    assert torch.equal(sequence(6, 1), first)  # the global generator has no part in it
    assert not torch.equal(first[0], first[1])
    drawn = sequence(5, None)
    assert torch.equal(sequence(5, None), drawn)
    for other in (sequence(5, 2), drawn, sequence(6, None)):
        assert not torch.equal(other, first)
    assert not torch.equal(sequence(6, None), drawn)


@pytest.mark.parametrize("calls", [0, 3])
def test_a_resumed_run_goes_on_in_the_same_sequence(calls):
    noise = SensorNoise(**ALL, seed=1)
    for _ in range(calls):
        noise.compute(*maps())
    saved = noise.state_dict()
    copies = [copy.deepcopy(noise), pickle.loads(pickle.dumps(noise)), noise.clone()]
    noise.clone().compute(*maps())  # as an evaluation's env does: the original goes on unchanged
    want = [noise.compute(*maps())[2] for _ in range(2)]
    resumed = SensorNoise(**ALL, seed=1)
    resumed.compute(*maps())  # whatever it did before
    resumed.load_state_dict(saved)
    for again in (resumed, *copies):
        assert all(torch.equal(again.compute(*maps())[2], w) for w in want)
    unused = SensorNoise(**ALL, seed=1)
    unused.load_state_dict(saved)
    torch.testing.assert_close(unused.state_dict(), saved)  # loaded and saved again before use


def frames(count: int) -> torch.Tensor:
    """Names of frames as a street gives them: its episodes' seeds are large, steps are not."""
    return torch.stack([2_000_000 + torch.arange(count) // 7, torch.arange(count) % 7], -1)


def noisy_by_frame(frame: torch.Tensor) -> tuple[torch.Tensor, ...]:
    noise = SensorNoise(**ALL, frame_key=("sensor", "frame"))
    given = (value[0].expand(*frame.shape[:-1], *value.shape[1:]) for value in maps())
    return noise.compute(*given, frame)


def test_a_frame_has_its_noise_in_any_batch_bit_for_bit():
    order = torch.randperm(500, generator=torch.manual_seed(3))
    many = noisy_by_frame(frames(500))
    shuffled = noisy_by_frame(frames(500)[order])
    square = noisy_by_frame(frames(500).reshape(20, 25, 2))
    for whole, mixed, folded in zip(many, shuffled, square):
        assert torch.equal(mixed.nan_to_num(), whole[order].nan_to_num())
        assert torch.equal(folded.flatten(0, 1).nan_to_num(), whole.nan_to_num())
    for whole, single in zip(many, noisy_by_frame(frames(500)[333])):
        assert torch.equal(single.nan_to_num(), whole[333].nan_to_num())


def test_noise_by_frame_is_in_no_state_and_the_same_at_the_root_and_under_next():
    noise = SensorNoise(**ALL, frame_key=("sensor", "frame"))
    depth, motion, flow = maps(6)

    def moments(rows: slice) -> TensorDict:
        sensor = {"depth": depth, "prev_from_curr": motion, "frame": frames(6)}
        return TensorDict({"sensor": sensor, "raw": flow}, [6])[rows].clone()

    before = noise.state_dict()
    batch = noise(moments(slice(0, 5)).set("next", moments(slice(1, 6))))
    assert torch.equal(batch["raw"][1:], batch["next", "raw"][:-1])
    assert not torch.equal(batch["raw"][:1], batch["next", "raw"][:1])
    torch.testing.assert_close(noise.state_dict(), before)
    assert not any(len(value) for value in before.values())


def noisy_env() -> TransformedEnv:
    return TransformedEnv(FakeSensorEnv(), SensorNoise(drift_m=0.5))


@pytest.mark.slow
@pytest.mark.parametrize(
    "batched", [SerialEnv, functools.partial(ParallelEnv, mp_start_method="fork")]
)
def test_envs_of_one_function_draw_noise_of_their_own(batched):
    # Env 0 twice: what differs between the two is the noise alone.
    env = batched(2, noisy_env)
    try:
        motion = env.rollout(2)["sensor", "prev_from_curr"][:, :, :3, 3]
    finally:
        env.close()
    assert (motion[0] != motion[1]).all()


# The first outputs of the generator's reference implementation for seed 1234567.
REFERENCE = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]


def test_split_mix_gives_the_numbers_of_its_reference():
    states = [(1234567 + step * 0x9E3779B97F4A7C15) % 2**64 for step in range(4)]
    signed = torch.tensor([state - 2**64 * (state >= 2**63) for state in states])
    assert [int(number) % 2**64 for number in split_mix(signed)] == REFERENCE


def test_numbers_of_known_bits_by_hand():
    # Low 24 bits 2^23 - 1 and 2^23 lie 2^-24 below and above 0, where a normal number is
    # sqrt(2 pi) / 2 times as far; all ones is the largest of all.
    bits = torch.tensor([2**23 - 1, 2**23, 2**24 - 1, 0])
    near = math.sqrt(2 * math.pi) / 2 * 2.0**-24
    got = normal(bits).double()
    torch.testing.assert_close(got[:2], torch.tensor([-near, near]).double(), rtol=1e-5, atol=0)
    torch.testing.assert_close(got[2], torch.tensor(5.4199).double(), rtol=1e-3, atol=0)
    assert got[3] == -got[2]
    # The high 24 bits: none, all, and the sign bit alone, which is a half.
    bits = torch.tensor([2**40 - 1, -1, -(2**63)])
    assert uniform(bits).tolist() == [0.0, 1.0 - 2.0**-24, 0.5]


@pytest.mark.slow
def test_numbers_by_frame_are_spread_as_they_should_be_and_neighbours_have_nothing_in_common():
    # A million numbers: 100 frames of 100 episodes, 100 of each. Limits are five standard errors.
    million, frame = 1_000_000, torch.cartesian_prod(torch.arange(100), torch.arange(100))
    bits = frame_bits(frame.reshape(100, 100, 2), (100,), seed=0, stream=0)
    x, u = normal(bits), uniform(bits)
    steps = torch.linspace(0, 1, million, dtype=torch.float64)
    of_normal = 0.5 * (1 + torch.erf(x.double() / math.sqrt(2)))
    for shares in (u.double(), of_normal):  # Kolmogorov and Smirnov's distance
        assert (shares.flatten().sort().values - steps).abs().max() < 2.2 / million**0.5
    assert abs((x * (u - 0.5)).mean()) < 5 * (1 / 12 / million) ** 0.5
    for dim, lag in itertools.product(range(3), (1, 7)):  # episodes, steps and places
        pairs = x.narrow(dim, lag, 100 - lag) * x.narrow(dim, 0, 100 - lag)
        assert abs(pairs.mean()) < 5 / pairs.numel() ** 0.5, (dim, lag)
    assert len(bits.unique()) == bits.numel()


def test_every_part_of_the_name_counts():
    same = frame_bits(torch.tensor([[12, 0]]), (50,), seed=3, stream=1)
    for name, seed, stream in [
        *(([12, 0], 4, 1), ([12, 0], 3, 2)),
        *(([12, 1], 3, 1), ([0, 12], 3, 1), ([12], 3, 1)),
    ]:
        assert not (frame_bits(torch.tensor([name]), (50,), seed=seed, stream=stream) == same).any()
