import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded

from flowrep.agent.map_codec import map_codecs
from flowrep.agent.replay import ReplayMemory
from flowrep.transforms import Mirror

SPEC = Composite(view=Unbounded((1, 36, 36)))


def memory(capacity=100, batch_size=400, **options):
    codecs = map_codecs(SPEC, ["view"], torch.float32)
    return ReplayMemory(codecs, capacity=capacity, batch_size=batch_size, device="cpu", **options)


def view(numbers):
    """Maps that show one number each."""
    numbers = torch.as_tensor(numbers, dtype=torch.float32)
    return numbers[..., None, None, None].expand(*numbers.shape, 1, 36, 36).clone()


def step(seen, following, ended="", action=None, begun=""):
    """One step of N environments; `ended` has a letter for each: t(erminated), c(ut off), or -.

    So has `begun`: b where an episode begins with this step.
    """
    size = len(seen)
    ended, begun = ended or "-" * size, begun or "-" * size
    terminated = torch.tensor([e == "t" for e in ended]).unsqueeze(1)
    done = torch.tensor([e != "-" for e in ended]).unsqueeze(1)
    action = torch.tensor(seen if action is None else action, dtype=torch.long)
    return TensorDict(
        {
            "view": view(seen),
            "action": action,
            "is_init": torch.tensor([b == "b" for b in begun]).unsqueeze(1),
            "next": {
                "view": view(following),
                "reward": torch.tensor(following, dtype=torch.float32).unsqueeze(1),
                "terminated": terminated,
                "done": done,
            },
        },
        [size],
    )


def stored(*steps, **options):
    """The transitions of a memory of these steps."""
    replay = memory(**options)
    for each in steps:
        replay.extend(each)
    return transitions(replay)


def transitions(replay):
    """The distinct (seen, action, steps, reward, next, terminated) of a large sample, sorted."""
    batch = replay.sample()
    columns = [
        batch["view"][:, 0, 0, 0], batch["action"], batch["steps_to_next_obs"][:, 0],
        batch["next", "reward"][:, 0], batch["next", "view"][:, 0, 0, 0],
        batch["next", "terminated"][:, 0],
    ]  # fmt: skip
    rows = torch.stack([column.double() for column in columns], 1)
    return [tuple(row.tolist()) for row in rows.unique(dim=0)]


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        pytest.param(
            [step([10, 20], [11, 21]), step([11, 21], [12, 22])],
            [(10, 10, 1, 11, 11, 0), (20, 20, 1, 21, 21, 0)],
            id="the latest step of each environment waits for its next frame",
        ),
        pytest.param(
            [step([10, 20], [11, 21], ended="t-")],
            [(10, 10, 1, 11, 10, 1)],
            id="a terminated step is there at once with its own map as a stand-in",
        ),
        pytest.param(
            [step([10, 20], [11, 21], ended="t-"), step([50, 21], [51, 22])],
            [(10, 10, 1, 11, 10, 1), (20, 20, 1, 21, 21, 0)],
            id="50 is a new episode: it is not what followed 10",
        ),
        pytest.param(
            [step([10, 20], [11, 21], ended="c-"), step([50, 21], [51, 22])],
            [(20, 20, 1, 21, 21, 0)],
            id="a step that was cut off is left out",
        ),
        pytest.param(
            [step([10, 20], [11, 21]), step([0, 21], [1, 22], begun="b-"), step([1, 22], [2, 23])],
            [(0, 0, 1, 1, 1, 0), (20, 20, 1, 21, 21, 0), (21, 21, 1, 22, 22, 0)],
            id="environment 0 began anew without being done",
        ),
    ],
)
def test_the_next_observation_is_that_of_the_next_step_of_the_episode(steps, expected):
    assert stored(*steps) == expected


def test_two_episodes_are_not_joined_even_if_their_maps_are_equal():
    replay = memory(n_steps=3)
    # object flow where nothing moves, or where nothing is known: every map is the same
    zero, nan = [0, 0], [float("nan")] * 2
    replay.extend(step(zero, zero, action=[1, 2]))
    replay.extend(step(zero, zero, action=[3, 4], ended="tc"))
    replay.extend(step(zero, nan, action=[5, 6], begun="bb"))
    replay.extend(step(nan, nan, action=[7, 8]))
    batch = replay.sample()
    spans = set(zip(batch["action"].tolist(), batch["steps_to_next_obs"][:, 0].tolist()))
    # what was cut off, action 4, has no successor, so 2 ends before it
    assert spans == {(1, 2), (3, 1), (2, 1), (5, 1), (6, 1)}


def test_steps_without_the_mark_of_restarts_are_refused():
    with pytest.raises(KeyError, match=r"lack 'is_init'.* append TorchRL's InitTracker"):
        memory().extend(step([1], [2]).exclude("is_init"))


def test_steps_may_come_one_by_one_or_in_a_batch_with_its_time_last_or_named():
    steps = [
        step([10, 20], [11, 21]),
        step([11, 21], [12, 22], ended="-t"),
        step([12, 40], [13, 41], ended="t-"),
        step([60, 41], [61, 42]),
    ]
    named = torch.stack(steps, 1)
    named.names = [None, "time"]
    expected = [
        (10, 10, 1, 11, 11, 0), (11, 11, 1, 12, 12, 0), (12, 12, 1, 13, 12, 1),
        (20, 20, 1, 21, 21, 0), (21, 21, 1, 22, 21, 1), (40, 40, 1, 41, 41, 0),
    ]  # fmt: skip
    assert stored(*steps) == stored(named) == expected
    assert stored(torch.stack(steps[:3], 1), torch.stack(steps[3:], 1)) == expected
    trajectory, single = torch.cat([step([i], [i + 1]) for i in range(3)]), memory()
    trajectory.names = ["time"]
    assert [single.add(each) for each in trajectory.unbind(0)] == [0, 1, 2]
    expected = [(0, 0, 1, 1, 1, 0), (1, 1, 1, 2, 2, 0)]
    assert stored(trajectory) == transitions(single) == expected


def collected(numbers, trajectories):
    """Steps `[N, T]` of a TorchRL collector; each frame's number follows that of the one before."""
    seen = torch.tensor(numbers)
    steps = [step(column.tolist(), (column + 1).tolist()) for column in seen.unbind(1)]
    data = torch.stack(steps, 1)
    data["collector", "traj_ids"] = torch.tensor(trajectories)[:, None].expand(data.shape).clone()
    return data.refine_names(None, "time")


def test_batches_of_several_workers_of_a_collector_are_not_joined():
    replay = memory()
    replay.extend(collected([[10, 11], [20, 21]], [0, 1]))
    replay.extend(collected([[12, 13], [22, 23]], [0, 1]))
    replay.extend(collected([[50, 51], [60, 61]], [2, 3]))  # as MultiAsyncCollector yields them
    pairs = {(seen, following) for seen, _, _, _, following, _ in transitions(replay)}
    assert pairs == {(n, n + 1) for n in (10, 11, 12, 20, 21, 22, 50, 60)}


def test_a_collector_s_batch_that_was_flattened_is_refused():
    with pytest.raises(ValueError, match=r"6 steps.*2 trajectories.*reshape\(-1\)"):
        memory().extend(collected([[10, 11, 12], [20, 21, 22]], [0, 1]).reshape(-1))
    one_each = collected([[10], [20]], [0, 1])  # which is what a flat batch means
    memory().extend(one_each.reshape(-1))


def test_a_full_memory_overwrites_its_oldest_rows():
    replay = memory(capacity=7)  # not a multiple of the two environments
    for i in range(9):
        replay.extend(step([i, 100 + i], [i + 1, 101 + i]))
    assert len(replay) == 7
    # of slots for steps 5 (second half), 6, 7, 8 all but step 8 know their next frame
    rows = (6, 7, 105, 106, 107)
    assert transitions(replay) == [(i, i, 1, i + 1, i + 1, 0) for i in rows]


def test_a_transition_of_three_steps_sums_discounted_rewards_and_looks_three_frames_ahead():
    steps = [step([seen], [seen + 1]) for seen in range(10, 15)]  # the reward of that to 11 is 11
    # from 10: 11 + 12 / 2 + 13 / 4 = 20.25 and 13; undiscounted it would be 36. From 12 on, what
    # follows the third step is not stored: transitions are shorter
    assert stored(*steps, n_steps=3, gamma=0.5) == [
        (10, 10, 3, 20.25, 13, 0),
        (11, 11, 3, 22.0, 14, 0),
        (12, 12, 2, 20.0, 14, 0),
        (13, 13, 1, 14.0, 14, 0),
    ]


def test_a_transition_of_three_steps_ends_with_its_episode():
    first = step([10, 20], [11, 21]), step([11, 21], [12, 22], ended="tc")
    then = step([50, 60], [51, 61]), step([51, 61], [52, 62])
    # 10 ends at the terminal step, whose own map stands in; 20 before the one that was cut off
    assert stored(*first, *then, n_steps=3, gamma=0.5) == [
        (10, 10, 2, 17.0, 11, 1),
        (11, 11, 1, 12.0, 11, 1),
        (20, 20, 1, 21.0, 21, 0),
        (50, 50, 1, 51.0, 51, 0),
        (60, 60, 1, 61.0, 61, 0),
    ]


def test_sampling_is_uniform_with_replacement():
    torch.manual_seed(0)
    replay = memory(batch_size=4000)
    replay.extend(step(list(range(5)), list(range(1, 6)), ended="ttttt"))
    counts = torch.bincount(replay.sample()["action"], minlength=5)
    # four standard deviations of 800 draws are 101
    assert ((counts - 800).abs() < 101).all()


def test_each_map_is_stored_once_and_takes_two_bytes_a_number():
    replay = memory(capacity=50)
    for i in range(30):
        replay.extend(step([i, 50 + i], [i + 1, 51 + i]))
    rows = replay.state_dict()["_storage"]["rows"]
    maps = [t for t in rows.values() if t.dim() > 2]
    assert [t.nbytes for t in maps] == [50 * 36 * 36 * 2]


def test_a_capacity_that_is_too_small_is_refused_with_the_least_that_fits():
    with pytest.raises(ValueError, match="n_steps is 0"):
        memory(n_steps=0)
    with pytest.raises(ValueError, match=r"capacity of 5 .* one|hold 6"):
        memory(capacity=5).extend(step([1, 2, 3], [2, 3, 4]))
    memory(capacity=6).extend(step([1, 2, 3], [2, 3, 4]))


def by_state(first, second, _):
    state = first.state_dict()
    second.load_state_dict({k: dict(v) if isinstance(v, dict) else v for k, v in state.items()})


def by_folder(first, second, folder):
    for _ in range(2):  # the second time over the first
        first.dumps(folder / "replay")
    second.loads(folder / "replay")


@pytest.mark.parametrize("move", [by_state, by_folder])
@pytest.mark.parametrize("used", [0, 9])
def test_a_restored_memory_draws_what_the_saved_one_draws(tmp_path, move, used):
    first, second = memory(capacity=11), memory(capacity=11)
    for i in range(8):  # more rows than it holds
        first.extend(step([i, 100 + i], [i + 1, 101 + i]))
    for i in range(used):
        second.extend(step([50 + i], [51 + i]))
    move(first, second, tmp_path)
    for replay in (first, second):
        replay.extend(step([8, 108], [9, 109]))
        torch.manual_seed(3)
        replay.drawn = replay.sample()
    assert (first.drawn == second.drawn).all()


def test_an_empty_memory_is_restored_and_one_of_another_capacity_refused():
    replay = memory()
    with pytest.raises(RuntimeError, match="nothing to sample"):
        replay.sample()
    replay.load_state_dict(memory().state_dict())
    replay.extend(step([1], [2], ended="t"))
    assert transitions(replay) == [(1, 1, 1, 2, 1, 1)]
    with pytest.raises(ValueError, match="capacity 100, this one 12; set replay_capacity=100"):
        memory(capacity=12).load_state_dict(replay.state_dict())


def test_an_agent_that_mirrors_learns_from_observations_and_from_their_mirror_images(
    make_agent, random_steps
):
    mirror = Mirror(["flow", "seg"], flow_keys="flow", swapped_actions=[0, 2, 1])
    agent = make_agent(mirror=True, mirror_image=mirror, batch_size=200)
    steps = random_steps(1)
    steps["next", "terminated"] = steps["next", "done"] = torch.ones(1, 1, dtype=torch.bool)
    agent.remember(steps)
    batch, u = agent.sample(), steps["flow"][0, 0]
    is_image = [torch.equal(seen[0].float(), -u.flip(-1)) for seen in batch["flow"]]
    assert 60 < sum(is_image) < 140
    assert all(torch.equal(seen[0].float(), u) for seen in batch["flow"][~torch.tensor(is_image)])
    # what is stored has no image
    assert torch.equal(agent.memory.storage[:]["flow"][0, 0].float(), u)
    assert torch.isfinite(agent.update(batch)["q_loss"])
    with pytest.raises(ValueError, match="mirror_image"):
        make_agent(mirror=True)
