"""Frame stacks, replayed by hand: which frames does each step hold?

`FakeSensorEnv`'s frames tell their (env, episode, step). Episodes of env 0 have 3 steps, those of
env 1 have 4, so that in a batch one env starts anew while the other goes on.
"""

from __future__ import annotations

import functools

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Categorical,
    LazyTensorStorage,
    SliceSampler,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, GymWrapper, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, MultiStepTransform
from torchrl.envs.utils import step_mdp

from flowrep.transforms import Depth, FrameStack, Segmentation
from flowrep.transforms.frame_stack import stack_trajectory
from tests.transforms.fake_env import NUM_CLASSES, FakeSensorEnv, SelfResettingEnv, moment

# By env, at t = 0 … 7: the (episode, step) of each frame of the stack that the policy sees.
SEEN = {
    0: [
        [(0, 0), (0, 0), (0, 0)],
        [(0, 0), (0, 0), (0, 1)],
        [(0, 0), (0, 1), (0, 2)],
        [(1, 0), (1, 0), (1, 0)],  # the episode ended: nothing of it is left
        [(1, 0), (1, 0), (1, 1)],
        [(1, 0), (1, 1), (1, 2)],
        [(2, 0), (2, 0), (2, 0)],
        [(2, 0), (2, 0), (2, 1)],
    ],
    1: [
        [(0, 0), (0, 0), (0, 0)],
        [(0, 0), (0, 0), (0, 1)],
        [(0, 0), (0, 1), (0, 2)],
        [(0, 1), (0, 2), (0, 3)],  # this env goes on where the other starts anew
        [(1, 0), (1, 0), (1, 0)],
        [(1, 0), (1, 0), (1, 1)],
        [(1, 0), (1, 1), (1, 2)],
        [(1, 1), (1, 2), (1, 3)],
    ],
}
# The same for the stack under "next": at the end of an episode its last frame is in it.
NEXT = {
    0: [*SEEN[0][1:3], [(0, 1), (0, 2), (0, 3)], *SEEN[0][4:6], [(1, 1), (1, 2), (1, 3)]],
    1: [*SEEN[1][1:4], [(0, 2), (0, 3), (0, 4)], *SEEN[1][5:7]],
}

KEY, STACK = ("sensor", "depth"), "depth3"


def stack_of_three() -> FrameStack:
    return FrameStack(k=3, in_keys=[KEY], out_keys=[STACK])


def single(env: int) -> EnvBase:
    return FakeSensorEnv((), env)


def stacked_single(env: int) -> EnvBase:
    return TransformedEnv(single(env), stack_of_three())


ENVS = {
    "batched env": lambda: TransformedEnv(FakeSensorEnv((2,)), stack_of_three()),
    "serial, stacked outside": lambda: TransformedEnv(
        SerialEnv(2, [functools.partial(single, i) for i in (0, 1)]), stack_of_three()
    ),
    "serial, stacked inside": lambda: SerialEnv(
        2, [functools.partial(stacked_single, i) for i in (0, 1)]
    ),
    "parallel, stacked outside": lambda: TransformedEnv(
        ParallelEnv(2, [functools.partial(single, i) for i in (0, 1)], mp_start_method="fork"),
        stack_of_three(),
    ),
    "parallel, stacked inside": lambda: ParallelEnv(
        2, [functools.partial(stacked_single, i) for i in (0, 1)], mp_start_method="fork"
    ),
}


def frames_of(stacks: torch.Tensor) -> list[list[tuple[int, int]]]:
    """Returns the (episode, step) of each frame of each stack `[T, 3, H, W]`."""
    return [[moment(frame.unsqueeze(0))[1:] for frame in stack] for stack in stacks]


def later(stacks: list[list[tuple[int, int]]], episodes: int = 1) -> list[list[tuple[int, int]]]:
    """Returns the stacks of the same steps some episodes later."""
    return [[(episode + episodes, step) for episode, step in stack] for stack in stacks]


@pytest.mark.parametrize("make_env", ENVS.values(), ids=list(ENVS))
def test_stacks_hold_the_frames_of_their_own_env_and_episode(make_env):
    env = make_env()
    try:
        until_done = env.rollout(3)
        trajectories = env.rollout(8, break_when_any_done=False)
    finally:
        env.close()
    for i in (0, 1):
        assert frames_of(until_done[STACK][i]) == SEEN[i][:3]
        assert frames_of(trajectories[STACK][i]) == later(SEEN[i])
        assert frames_of(trajectories["next", STACK][i])[:6] == later(NEXT[i])
        assert all(moment(f[None])[0] == i for s in trajectories[STACK][i] for f in s)


def test_a_worker_is_given_the_stack_that_its_step_continues():
    env = ENVS["parallel, stacked inside"]()
    try:
        first = env.reset().set("action", torch.zeros(2, dtype=torch.long))
        td = first.clone()
        for _ in range(2):
            td = step_mdp(env.step(td), keep_other=False).set("action", first["action"])
        again = env.step(first)  # from the first stack, though the env itself has gone on
    finally:
        env.close()
    assert frames_of(again["next", STACK]) == [[(0, 0), (0, 0), (0, 3)]] * 2


def test_a_collector_goes_on_where_its_last_batch_ended():
    env = TransformedEnv(FakeSensorEnv((2,)), stack_of_three())
    collector = Collector(env, frames_per_batch=2 * 3, total_frames=2 * 9)
    batches = torch.cat([batch.clone() for batch in collector], -1)
    for i in (0, 1):
        assert frames_of(batches[STACK][i])[:8] == SEEN[i]


def test_vectorised_gymnasium_env_with_partial_resets():
    gymnasium = pytest.importorskip("gymnasium")

    class Counter(gymnasium.Env):
        """Shows 100 · env + 10 · episode + step in both pixels."""

        observation_space = gymnasium.spaces.Box(0, 255, (1, 1, 2), dtype="uint8")
        action_space = gymnasium.spaces.Discrete(2)

        def __init__(self, env: int) -> None:
            self.env, self.episode, self.step_count = env, -1, 0

        def _observe(self):
            value = 100 * self.env + 10 * self.episode + self.step_count
            return torch.full((1, 1, 2), value, dtype=torch.uint8).numpy()

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.episode, self.step_count = self.episode + 1, 0
            return self._observe(), {}

        def step(self, action):
            self.step_count += 1
            return self._observe(), 0.0, self.step_count == 2 + self.env, False, {}

    vector = gymnasium.vector.SyncVectorEnv(
        [functools.partial(Counter, i) for i in (0, 1)],
        autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED,
    )
    stack = FrameStack(k=2, in_keys=["observation"], out_keys=["observation2"])
    env = TransformedEnv(GymWrapper(vector), stack)
    seen = env.rollout(5, break_when_any_done=False)["observation2"][..., 0, 0].int()
    assert seen.tolist() == [
        [[0, 0], [0, 1], [10, 10], [10, 11], [20, 20]],
        [[100, 100], [100, 101], [101, 102], [110, 110], [110, 111]],
    ]


def test_an_env_that_resets_itself_starts_its_stacks_anew():
    env = TransformedEnv(SelfResettingEnv((2,)), stack_of_three())
    stacks = env.rollout(8, break_when_any_done=False)[STACK]
    for i in (0, 1):
        assert frames_of(stacks[i]) == SEEN[i]


def test_trajectory_with_done_flags_gives_what_the_env_gave():
    env = TransformedEnv(FakeSensorEnv((2,)), stack_of_three())
    online = env.rollout(8, break_when_any_done=False)
    offline = stack_of_three()(online.exclude(STACK, ("next", STACK)))
    assert torch.equal(offline[STACK].nan_to_num(), online[STACK].nan_to_num())
    assert torch.equal(offline["next", STACK].nan_to_num(), online["next", STACK].nan_to_num())


def test_time_may_be_any_dimension_of_a_trajectory():
    frames = torch.arange(6.0).reshape(3, 2, 1, 1, 1)  # [T, B, C, H, W]: env 0 has 0 2 4
    done = torch.tensor([[False, True], [False, False], [False, False]])
    want = [[[0, 0], [1, 1]], [[0, 2], [3, 3]], [[2, 4], [3, 5]]]
    assert stack_trajectory(frames, done, 2, 0).flatten(2).tolist() == want
    swapped = stack_trajectory(frames.transpose(0, 1), done.T, 2, 1)
    assert swapped.transpose(0, 1).flatten(2).tolist() == want


def test_shuffled_transitions_keep_their_stacks():
    # A transition stores the root's stack and the next frame; the next stack follows from them.
    env = TransformedEnv(FakeSensorEnv((2,)), stack_of_three())
    online = env.rollout(8, break_when_any_done=False).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(16), batch_size=64)
    buffer.append_transform(stack_of_three())
    buffer.extend(online.exclude(("next", STACK)))
    sample = buffer.sample()
    want = online["next", STACK][sample["index"]]
    assert torch.equal(sample["next", STACK].nan_to_num(), want.nan_to_num())


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
    assert torch.equal(kept[STACK].nan_to_num(), want[STACK].nan_to_num())
    assert torch.equal(kept["next", STACK].nan_to_num(), want["next", STACK].nan_to_num())


def test_what_a_stored_transition_costs():
    # k frames at the root and the newest one under "next": 4 depth maps, not the 6 of two stacks.
    env = TransformedEnv(FakeSensorEnv((2,)), stack_of_three())
    online = env.rollout(4).select(STACK, ("next", STACK), ("next", *KEY))
    lean = online.exclude(("next", STACK))
    one_map = 4 * 5 * 7
    assert (lean[STACK].nbytes + lean[("next", *KEY)].nbytes) == online.numel() * 4 * one_map
    assert (online[STACK].nbytes + online["next", STACK].nbytes) == online.numel() * 6 * one_map
    restored = stack_of_three()(lean)
    assert torch.equal(restored["next", STACK].nan_to_num(), online["next", STACK].nan_to_num())


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
    assert torch.equal(sample["next", STACK].nan_to_num(), want.nan_to_num())


def test_n_step_returns_without_stored_stacks_are_refused():
    with pytest.raises(KeyError, match=r"up to 3 steps ahead.*Store \('next', 'depth3'\)"):
        n_step_sample(3, ("next", STACK))
    sample, online = n_step_sample(1, ("next", STACK))  # the step after, as ever
    want = online["next", STACK][sample["index"]]
    assert torch.equal(sample["next", STACK].nan_to_num(), want.nan_to_num())


def test_transitions_without_past_are_refused():
    td = FakeSensorEnv((2,)).rollout(4, break_when_any_done=False).reshape(-1)
    with pytest.raises(KeyError, match=r"'depth3' is not in the batch.*named 'time'"):
        stack_of_three()(td)


def test_stepping_without_the_stack_of_the_step_before_is_refused():
    env = TransformedEnv(FakeSensorEnv(), stack_of_three())
    td = env.reset().exclude(STACK).set("action", torch.tensor(0))
    with pytest.raises(KeyError, match="needs 'depth3' of the previous step"):
        env.step(td)


def test_the_transform_remembers_nothing():
    # Two envs' steps interleaved through one transform: each continues its own stack.
    stack = FrameStack(k=2, in_keys=["x"], out_keys=["x2"])

    def td(**values: float) -> TensorDict:
        return TensorDict({key: torch.tensor(v).reshape(-1, 1, 1) for key, v in values.items()})

    a = stack._step(td(x2=[1.0, 2.0]), td(x=[3.0]))
    b = stack._step(td(x2=[7.0, 8.0]), td(x=[9.0]))
    again = stack._step(td(x2=[1.0, 2.0]), td(x=[3.0]))
    assert [t["x2"].flatten().tolist() for t in (a, b, again)] == [[2, 3], [8, 9], [2, 3]]
    assert not stack.state_dict()


def test_stacked_ids_stay_ids():
    stack = Compose(Segmentation(NUM_CLASSES), FrameStack(in_keys=["seg"], out_keys=["seg2"]))
    env = TransformedEnv(FakeSensorEnv((3,)), stack)
    spec = env.observation_spec["seg2"]
    assert isinstance(spec, Categorical)
    assert (spec.space.n, spec.shape, spec.dtype) == (NUM_CLASSES, (3, 2, 5, 7), torch.uint8)


def test_stacked_depth_stays_bounded_and_other_maps_unbounded():
    keys = {"in_keys": ["depth", ("sensor", "depth")], "out_keys": ["depth2", "metres2"]}
    env = TransformedEnv(FakeSensorEnv(), Compose(Depth(), FrameStack(**keys)))
    depth2, metres2 = env.observation_spec["depth2"], env.observation_spec["metres2"]
    assert isinstance(depth2, Bounded)
    assert depth2.space.low.shape == (2, 5, 7)
    assert (depth2.space.low.min(), depth2.space.high.max()) == (0, 1)
    assert isinstance(metres2, Unbounded)
    assert metres2.shape == (2, 5, 7)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"k": 0}, "at least 1; got 0"),
        ({"out_keys": ["seg"]}, "an output key of its own"),
        ({"out_keys": ["a", "b"]}, "an output key of its own"),
    ],
)
def test_options_are_checked(options, expected):
    with pytest.raises(ValueError, match=expected):
        FrameStack(**{"in_keys": ["seg"], "out_keys": ["seg2"], **options})
