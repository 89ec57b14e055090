"""Frame stacks beyond the contract: workers, collectors, slices of episodes and n-step returns.

`FakeSensorEnv`'s frames tell their (env, episode, step). Episodes of env 0 have 3 steps, those of
env 1 have 4, so that in a batch one env starts anew while the other goes on.
"""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    Bounded,
    Categorical,
    LazyTensorStorage,
    SliceSampler,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import (
    Compose,
    DTypeCastTransform,
    MultiStepTransform,
    ObservationNorm,
    SelectTransform,
)

from flowrep.transforms import Depth, FrameStack, Segmentation
from tests.transforms.fake_env import NUM_CLASSES, FakeSensorEnv, moment
from tests.transforms.oracles import same_bits

KEY, STACK = ("sensor", "depth"), "depth3"


def stack_of_three() -> FrameStack:
    return FrameStack(k=3, in_keys=[KEY], out_keys=[STACK])


def stacked_single(env: int) -> TransformedEnv:
    return TransformedEnv(FakeSensorEnv((), env), stack_of_three())


def test_time_may_be_any_dimension_of_a_trajectory():
    frames = torch.arange(6.0).reshape(3, 2, 1, 1, 1)  # [T, B, C, H, W]: env 0 has 0 2 4
    done = torch.tensor([[False, True], [False, False], [False, False]])
    td = TensorDict({"x": frames, "next": {"done": done}}, [3, 2], names=["time", None])
    stack = FrameStack(k=2, in_keys=["x"], out_keys=["x2"])
    want = [[[0, 0], [1, 1]], [[0, 2], [3, 3]], [[2, 4], [3, 5]]]
    assert stack(td.clone())["x2"].flatten(2).tolist() == want
    assert stack(td.transpose(0, 1))["x2"].transpose(0, 1).flatten(2).tolist() == want


def test_slices_of_single_frames_have_exact_stacks_from_the_kth_step_on():
    online = stacked_single(1).rollout(16, break_when_any_done=False)  # 4 episodes of 4 steps
    sampler = SliceSampler(slice_len=3, end_key=("next", "done"), strict_length=True)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(16), sampler=sampler, batch_size=3 * 20
    )
    buffer.extend(online.exclude(STACK, ("next", STACK)))
    slices = buffer.sample().reshape(20, 3).refine_names(None, "time")
    steps = {moment(depth)[2] for depth in slices[:, 0][KEY]}
    assert steps == {0, 1}  # some slices begin in the middle of an episode
    kept = stack_of_three()(slices)[:, 2:]
    want = online[kept["index"].reshape(20, 1)]
    assert same_bits(kept[STACK], want[STACK])
    assert same_bits(kept["next", STACK], want["next", STACK])


def n_step_sample(n_steps: int, *left_out):
    """Returns shuffled transitions of n steps, and what the env gave with them."""
    online = stacked_single(1).rollout(12, break_when_any_done=False)  # 3 episodes of 4 steps
    online.refine_names("time")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(16), batch_size=64)
    buffer.append_transform(stack_of_three())
    buffer.append_transform(MultiStepTransform(n_steps=n_steps, gamma=0.9))
    buffer.extend(online.exclude(*left_out))
    return buffer.sample(), online


def test_n_step_returns_keep_the_stack_that_was_stored():
    sample, online = n_step_sample(3)
    first = sample["index"]
    assert (sample["steps_to_next_obs"] == 3).any()
    last = first + sample["steps_to_next_obs"].flatten() - 1
    want = online["next", STACK][last]
    assert same_bits(sample["next", STACK], want)


def test_n_step_returns_without_stored_stacks_are_refused():
    with pytest.raises(KeyError, match=r"up to 3 steps ahead.*Store \('next', 'depth3'\)"):
        n_step_sample(3, ("next", STACK))
    _, online = n_step_sample(3)
    trajectory = online.exclude(STACK, "next").update(online.select(("next", "done")))
    trajectory["steps_to_next_obs"] = torch.full((12, 1), 3)
    with pytest.raises(KeyError, match=r"'depth3' is not in the batch.*up to 3 steps ahead"):
        stack_of_three()(trajectory)
    sample, online = n_step_sample(1, ("next", STACK))  # the step after, as ever
    want = online["next", STACK][sample["index"]]
    assert same_bits(sample["next", STACK], want)


def test_a_frame_stack_without_its_previous_step_is_refused():
    td = FakeSensorEnv((2,)).rollout(4, break_when_any_done=False).reshape(-1)
    with pytest.raises(KeyError, match=r"'depth3' is not in the batch.*named 'time'"):
        stack_of_three()(td)
    env = TransformedEnv(FakeSensorEnv(), stack_of_three())
    td = env.reset().exclude(STACK).set("action", torch.tensor(0))
    with pytest.raises(KeyError, match="needs 'depth3' of the previous step"):
        env.step(td)


def normalised(key):
    return ObservationNorm(loc=0.0, scale=0.1, in_keys=[key])


@pytest.mark.parametrize(
    ("later", "said"),
    [
        (lambda: normalised(STACK), f"ObservationNorm writes to '{STACK}'"),
        (lambda: Compose(Depth(), normalised(STACK)), f"ObservationNorm writes to '{STACK}'"),
        (lambda: DTypeCastTransform(torch.float32, torch.float64, [STACK]), "writes to"),
        (lambda: SelectTransform(KEY), f"drops '{STACK}'"),  # each step would read the first frame
    ],
)
def test_a_transform_that_changes_a_carried_stack_is_refused(later, said):
    with pytest.raises(ValueError, match=said):
        TransformedEnv(FakeSensorEnv((), 1), Compose(stack_of_three(), later())).rollout(2)
    elsewhere = ObservationNorm(loc=0.0, scale=0.1, in_keys=[STACK], out_keys=["normal"])
    env = TransformedEnv(FakeSensorEnv((), 1), Compose(normalised(KEY), stack_of_three()))
    env.append_transform(elsewhere)
    seen = env.rollout(3)["next"]
    torch.testing.assert_close(seen["normal"], 0.1 * seen[STACK], equal_nan=True)


def test_wide_unsigned_maps_are_stacked_where_envs_end_at_different_times():
    wide = DTypeCastTransform(torch.uint8, torch.uint16, [("sensor", "rgb")], ["wide"])
    stacks = FrameStack(in_keys=["wide", ("sensor", "rgb")], out_keys=["wide2", "rgb2"])
    env = TransformedEnv(FakeSensorEnv((2,)), Compose(wide, stacks))
    td = env.rollout(5, break_when_any_done=False)
    assert td["wide2"].dtype == torch.uint16
    assert td["wide2"].to(torch.uint8).equal(td["rgb2"])


def test_a_policy_that_converts_the_stack_is_refused():
    def policy(td):
        td[STACK] = td[STACK].double()
        return td.set("action", torch.zeros(td.shape, dtype=torch.long))

    with pytest.raises(ValueError, match=f"'{STACK}' of the previous step is torch.float64"):
        stacked_single(1).rollout(2, policy)


def test_specs_stay_of_their_kind():
    keys = {"in_keys": ["depth", ("sensor", "depth"), "seg"], "out_keys": ["d2", "metres2", "seg2"]}
    stack = Compose(Depth(), Segmentation(NUM_CLASSES), FrameStack(**keys))
    spec = TransformedEnv(FakeSensorEnv((3,)), stack).observation_spec
    assert spec["d2"] == Bounded(0.0, 1.0, shape=(3, 2, 5, 7))
    assert spec["metres2"] == Unbounded((3, 2, 5, 7))
    assert spec["seg2"] == Categorical(NUM_CLASSES, shape=(3, 2, 5, 7), dtype=torch.uint8)
