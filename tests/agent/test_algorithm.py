"""What holds for every algorithm of conf/algorithm/."""

import math
from functools import partial
from unittest.mock import patch

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.data import Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.agent import load_checkpoint, save_checkpoint
from flowrep.agent.algorithm import WARM_UP, DivergenceError, DivergenceWatch, of_one_shape

ENVS = 5


def learn(agent, random_steps, steps, frames=0):
    """Takes in so many steps of five environments, with the updates that they bring."""
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


def test_an_update_moves_all_weights_and_returns_what_it_says(make_any, random_steps):
    agent = make_any()
    before = weights(agent)
    (*_, last) = learn(agent, random_steps, 12)
    assert [name for name, weight in weights(agent).items() if weight.equal(before[name])] == []
    assert tuple(sorted(last)) == tuple(sorted(agent.metric_names()))
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


@pytest.mark.slow_after_first
def test_the_learning_rate_ends_at_zero_with_the_frames(make_any, random_steps):
    agent = make_any(total_frames=100, learning_rate=2**-10)
    metrics = learn(agent, random_steps, 20)
    rates = [m["learning_rate"].item() for m in metrics]
    assert len(rates) == agent.total_updates
    assert rates[0] == 2**-10
    assert rates[-1] == pytest.approx(2**-10 / len(rates))


def test_off_policy_updates_are_due_after_a_first_batch_and_then_every_ten_frames(make_agent):
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
    a, b = weights(whole), weights(resumed)
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


@pytest.mark.slow_after_first
def test_an_agent_that_diverged_keeps_its_weights_and_can_begin_anew(make_any, random_steps):
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
    assert [name for name, w in weights(new).items() if not torch.equal(w, after[name])] == []


@pytest.mark.slow_after_first
def test_one_hot_actions_teach_what_categorical_ones_do(make_any, random_steps):
    agents = plain, one_hot = make_any(), make_any(action_spec=OneHot(3))
    for _ in range(8):
        steps = random_steps(ENVS)
        plain.remember(steps)
        one_hot.remember(steps.copy().set("action", F.one_hot(steps["action"], 3)))
    for agent in agents:
        torch.manual_seed(1)
        for _ in range(3):
            agent.update(agent.sample())
    for name, weight in plain.weights.items():
        torch.testing.assert_close(one_hot.weights[name], weight)


def test_a_state_of_other_maps_is_refused_by_name(make_agent):
    saved = make_agent(keys=["flow"]).state_dict()
    with pytest.raises(ValueError, match=r"does not fit this one in \d+ weights, first .* here, "):
        make_agent(keys=["flow", "seg"]).load_state_dict(saved)


@pytest.mark.slow_after_first
def test_a_policy_is_built_and_loaded_without_its_learner(
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


def test_the_first_bad_update_is_counted_and_told_with_its_metrics():
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


BATCHES = 7


def batches_of(agents, random_steps):
    """Samples for several updates, drawn before the first one; all agents see the same steps."""
    for _ in range(12):
        step = random_steps(ENVS).to(agents[0].device)
        for agent in agents:
            agent.remember(step)
    return [agents[0].sample() for _ in range(BATCHES)]


def state_of(agent):
    """All that an update changes, by name."""
    moments = {
        f"{name}/{key}": value
        for name, weight in agent.trained.items()
        for key, value in agent.optimizer.state[weight].items()
    }
    return agent.weights | moments


class Taped(TorchDispatchMode):
    """Does what a CUDA graph does, on a CPU: takes the kernels of one step again and again.

    Without any Python between, and on the same memory. The first steps are taken as they are.
    """

    def __init__(self, step):
        super().__init__()
        self.step, self.steps, self.calls = step, 0, []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if not func.is_view:  # a view of memory that is written again needs no second look
            self.calls.append((func, args, kwargs or {}, out))
        return out

    @torch.no_grad()
    def replay(self):
        for func, args, kwargs, out in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(out), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old is not new:
                    old.copy_(new)

    def __call__(self, batch):
        self.steps += 1
        if self.steps < WARM_UP:
            return self.step(batch)
        if self.steps == WARM_UP:
            static = batch.clone()
            self.inputs = static.copy()
            with self:
                self.out = self.step(static)
        else:
            self.inputs.update_(batch)
            self.replay()
        return self.out.clone()


@pytest.mark.slow_after_first
def test_an_update_from_the_tape_is_the_update(make_any, random_steps):
    """A bad batch, too: it stops the weights."""
    eager = make_any(learning_rate=0.01)
    with patch("flowrep.agent.algorithm.as_cuda_graph", lambda step, device: Taped(step)):
        taped = make_any(learning_rate=0.01)
    batches = batches_of([eager, taped], random_steps)
    for batch in (*batches[:-1], spoilt(batches[-2]), batches[-1]):
        expected, actual = eager.update(batch.clone()), taped.update(batch.clone())
        assert expected.keys() == actual.keys()
        differing = [n for n in expected if not torch.equal(expected[n], actual[n])]
        assert [n for n in differing if not expected[n].isnan()] == []
    expected, actual = state_of(eager), state_of(taped)
    assert [n for n in expected if not torch.equal(expected[n], actual[n])] == []
    for agent in (eager, taped):
        with pytest.raises(DivergenceError, match=f"in update {BATCHES} "):
            agent.divergence.check()


class Foreign(TorchDispatchMode):
    """Notes what passes between the CPU and another device, for which "meta" stands in."""

    def __init__(self):
        super().__init__()
        self.crossings = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, Tensor)]
        if {x.device.type for x in tensors} > {"meta"}:
            self.crossings.append(str(func))
        return out


def on_a_device_that_cannot_be_read(make_any):
    """An agent on "meta", which has shapes and no numbers, as good as a GPU that must not wait."""
    reads = {"item": lambda _: 0.5, "is_set_to": lambda *_: False, "__bool__": lambda _: True}
    with patch.multiple(Tensor, **reads):  # TorchRL looks into the weights when it is set up
        return make_any(device="meta")


def take_losses(agent, batch):
    losses = agent.losses(batch)
    torch.stack([x for name, x in losses.items() if name.endswith("_loss")]).sum().backward()
    agent.divergence.record(losses | {"grad_norm": agent._gradient_norm()})
    agent.after_update()


def test_an_update_asks_the_device_for_no_number_and_brings_it_none(make_any, random_steps):
    batch = batches_of([make_any()], random_steps)[0].to("meta")
    agent = on_a_device_that_cannot_be_read(make_any)
    assert agent.CAPTURABLE
    take_losses(agent, batch.copy())  # TorchRL brings its discount when it is first used
    with Foreign() as foreign:
        take_losses(agent, batch.copy())
    assert foreign.crossings == []


def test_an_algorithm_can_be_told_to_leave_graphs_alone(make_agent):
    with patch("flowrep.agent.algorithm.as_cuda_graph") as capture:
        agent = make_agent()
        assert capture.call_count == 1
        agent.load_state_dict(agent.state_dict())
        assert capture.call_count == 2
        agent.step_eagerly()
        agent.load_state_dict(agent.state_dict())
        assert capture.call_count == 2


def test_a_batch_unlike_the_first_is_refused_by_name():
    step = of_one_shape(lambda batch: batch)
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
    eager, graph, resumed = (make_any(device="cuda", seed=seed) for seed in (0, 0, 9))
    batches = batches_of([eager, graph, resumed], random_steps)
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
    for name, value in state_of(eager).items():
        close(state_of(graph)[name], value)
        close(state_of(resumed)[name], value)
