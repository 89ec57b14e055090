"""What holds for every algorithm of conf/algorithm/."""

import math
import platform
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.agent import cpu, load_checkpoint, save_checkpoint, torch_threads
from flowrep.agent.cuda_graph import with_fixed_layout
from flowrep.agent.divergence import DivergenceError, DivergenceWatch
from tests.comparing import differing
from tests.running import glossary, run_python

ENVS = 5


def learn(agent, random_steps, steps, frames=0):
    """Stores steps of five envs and takes the updates that are due; returns their metrics."""
    metrics = []
    for _ in range(steps):
        agent.remember(random_steps(ENVS))
        frames += ENVS
        metrics += [agent.update(agent.sample()) for _ in range(agent.updates_due(frames))]
    return metrics


def spoilt(batch):
    """A batch whose losses are nan."""
    bad = batch.clone()
    for key in (("next", "reward"), "advantage", "value_target"):
        if key in bad.keys(True):
            bad[key] = torch.full_like(bad[key], torch.nan)
    return bad


def weights(agent):
    return {name: w.clone() for name, w in agent.state_dict()["weights"].items()}


def test_an_update_moves_all_weights_and_returns_every_metric(make_any, random_steps):
    agent = make_any()
    before = weights(agent)
    (*_, last) = learn(agent, random_steps, 12)
    assert [name for name, weight in weights(agent).items() if weight.equal(before[name])] == []
    assert tuple(sorted(last)) == tuple(sorted(agent.metric_names()))
    assert {*last} <= glossary()
    assert all(value.shape == () and not value.requires_grad for value in last.values())
    assert all(value.isfinite() for name, value in last.items() if name != "explained_variance")


def test_a_transition_of_three_steps_is_discounted_three_times(make_any, random_steps, as_batch):
    agent, cubed = make_any(gamma=0.5), make_any(gamma=0.5**3)
    if not hasattr(agent.options, "frames_per_update"):
        pytest.skip("learns from whole rollouts")
    steps = random_steps(16)
    batch, once = as_batch(agent, steps), as_batch(agent, steps)
    batch["steps_to_next_obs"] = torch.full((16, 1), 3.0)
    loss, expected = agent.losses(batch)["q_loss"], cubed.losses(once)["q_loss"]
    torch.testing.assert_close(loss, expected)
    assert not torch.isclose(loss, agent.losses(once)["q_loss"])


def test_updates_from_replay_are_due_after_a_first_batch_and_then_every_ten_frames(make_agent):
    agent = make_agent(batch_size=16, frames_per_update=10)
    assert [agent.updates_due(frames) for frames in (0, 16, 25, 26, 66)] == [0, 0, 0, 1, 5]
    agent.updates = 2
    assert agent.updates_due(66) == 3


@pytest.mark.slow_after_first
def test_a_resumed_agent_equals_an_uninterrupted_one_bit_for_bit(make_any, random_steps, tmp_path):
    steps = 13  # an on-policy rollout of 8 is cut in its middle

    def go_on(agent):
        torch.manual_seed(2)
        return learn(agent, random_steps, 12, frames=steps * ENVS)

    whole = make_any()
    learn(whole, random_steps, steps)
    saved = {"agent": whole.state_dict(), "memory": whole.memory.state_dict()}
    save_checkpoint(tmp_path / "c", saved)
    expected = go_on(whole)

    resumed = make_any(seed=9)
    state = load_checkpoint(tmp_path / "c")
    resumed.load_state_dict(state["agent"])
    resumed.memory.load_state_dict(state["memory"])
    actual = go_on(resumed)
    assert len(expected) == len(actual) > 0
    for a, b in zip(expected, actual):
        assert all(torch.equal(a[name].nan_to_num(7), b[name].nan_to_num(7)) for name in a)
    assert differing(weights(whole), weights(resumed)) == []


@pytest.mark.slow_after_first
def test_an_agent_that_diverged_keeps_its_weights_until_a_state_is_loaded(make_any, random_steps):
    used, new = make_any(learning_rate=0.01), make_any(learning_rate=0.01)
    for _ in range(12):
        used.remember(random_steps(ENVS))
    batches = [used.sample() for _ in range(3)]
    bad = spoilt(batches[0])

    def diverge():
        for batch in batches:
            used.update(batch.clone())
        used.divergence.check()
        before = weights(used)
        used.update(bad.clone())
        used.update(batches[0].clone())
        assert [n for n in used.trained if not torch.equal(used.weights[n], before[n])] == []
        with pytest.raises(DivergenceError, match=r"_loss became nan in update 4 "):
            used.divergence.check()
        return before

    diverge()
    used.load_state_dict(new.state_dict())
    after = diverge()
    for batch in batches:
        new.update(batch.clone())
    assert differing(weights(new), after) == []


def test_a_state_of_other_maps_is_refused_with_a_weight_that_differs(make_agent):
    saved = make_agent(keys=["flow"]).state_dict()
    with pytest.raises(ValueError, match=r"does not fit this one in \d+ weights, first .* here, "):
        make_agent(keys=["flow", "seg"]).load_state_dict(saved)


@pytest.mark.slow_after_first
def test_a_policy_is_built_and_loaded_without_the_rest_of_the_agent(
    make_any, observation_spec, random_steps, random_maps, tmp_path
):
    """Of one environment, too, where a rollout would be less than a batch of PPO's."""
    (algorithm,) = make_any.args
    changes = {"layer_norm": True} if "layer_norm" in algorithm.OPTIONS.model_fields else {}
    agent = make_any(**changes)
    learn(agent, random_steps, 12)
    save_checkpoint(tmp_path / "c", {"policy": dict(agent.policy.state_dict())})
    policy = algorithm.make_policy(
        observation_spec[:1], Categorical(3), ["flow", "seg"], agent.options, total_frames=1000
    )
    maps = random_maps(20)
    with torch.no_grad():
        expected = agent.policy.get_dist(maps.clone()).probs
        assert not torch.equal(policy.get_dist(maps.clone()).probs, expected)
        policy.load_state_dict(load_checkpoint(tmp_path / "c")["policy"])
        assert torch.equal(policy.get_dist(maps.clone()).probs, expected)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = agent.policy(maps.clone())["action"]
            assert torch.equal(policy(maps.clone())["action"], greedy)
        assert torch.equal(expected.argmax(-1), greedy)
        drawn = policy(maps[:1].expand(1000).contiguous())["action"]
    # three standard deviations of a share are 0.047
    shares = torch.bincount(drawn, minlength=3) / 1000
    torch.testing.assert_close(shares, expected[0], atol=0.05, rtol=0)


def test_the_error_names_the_first_update_that_diverged_and_its_metrics():
    watch = DivergenceWatch(["q_loss", "actor_loss"], ["entropy"])
    is_bad, nan = watch.is_bad, math.nan  # the optimizer holds the tensor
    # what is logged beside the losses may be undefined
    rows = [(1.0, 2.0, nan, 0), (3.0, -math.inf, 0.25, 1), (nan, nan, 9.0, 1)]
    for first in (1, 41):
        for q_loss, actor_loss, entropy, expected in rows:
            values = {"q_loss": q_loss, "actor_loss": actor_loss, "entropy": entropy}
            watch.record({name: torch.tensor(value) for name, value in values.items()})
            assert is_bad == expected
            if not expected:
                watch.check()
        message = rf"^actor_loss .* -inf in update {first + 1} \(q_loss=3, .*entropy=0.25\)$"
        with pytest.raises(DivergenceError, match=message):
            watch.check()
        watch.reset(40)
        assert is_bad == 0


def test_a_batch_of_another_layout_is_refused_with_the_key_that_differs():
    step = with_fixed_layout(lambda batch: batch)
    first = TensorDict({"seen": torch.zeros(4, 2), "next": {"reward": torch.zeros(4, 1)}}, [4])
    assert step(first) is first
    step(first.clone().update({"td_error": torch.zeros(4)}))
    with pytest.raises(ValueError, match=r"'seen' \(\(4, 2\).* has it \(\(1, 2\)"):
        step(first[:1])
    with pytest.raises(ValueError, match=r"reward.*float32.*float64"):
        step(first.clone().update({"next": {"reward": torch.zeros(4, 1, dtype=torch.float64)}}))
    with pytest.raises(ValueError, match=r"reward.*absent"):
        step(first.exclude(("next", "reward")))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_graph_on_cuda_equals_the_steps_it_replaces_and_resumes(make_any, random_steps):
    eager, graph, resumed = agents = [make_any(device="cuda", seed=seed) for seed in (0, 0, 9)]
    for _ in range(12):
        step = random_steps(ENVS).to("cuda")
        for agent in agents:
            agent.remember(step)
    batches = [eager.sample() for _ in range(7)]
    eager.step_eagerly()
    for batch in batches[:5]:
        resumed.update(batch.clone())
    resumed.load_state_dict(eager.state_dict())
    close = partial(torch.testing.assert_close, rtol=1e-3, atol=1e-4, equal_nan=True)
    for batch in batches:
        expected = eager.update(batch.clone())
        for agent in (graph, resumed):
            metrics = agent.update(batch.clone())
            for name, value in expected.items():
                close(metrics[name], value)
    for agent in (graph, resumed):
        for name, weight in eager.weights.items():
            close(agent.weights[name], weight)
        for name, weight in eager.trained.items():
            moments = agent.optimizer.state[agent.trained[name]]
            for key, value in eager.optimizer.state[weight].items():
                close(moments[key], value)


COUNT_PAGE_FAULTS = """
import resource, runpy, sys
keep_freed_memory = runpy.run_path(sys.argv[1])["keep_freed_memory"]  # without TorchRL
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(2):
        bytearray(b"x") * 80_000_000  # some 20,000 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
by_default = faults()
assert keep_freed_memory()
faults()
print(by_default, faults())
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator")
def test_a_freed_block_is_reused_without_page_faults():
    result = run_python("-c", COUNT_PAGE_FAULTS, cpu.__file__, check=True)
    by_default, kept = map(int, result.stdout.split())
    assert kept < 0.1 * by_default


def test_the_number_of_threads_is_set_inside_and_restored_afterwards():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
