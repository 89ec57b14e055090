"""A gradient step can be a CUDA graph: shown on a CPU by a tape, and on CUDA where there is one."""

from unittest.mock import patch

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from flowrep.agent import layers
from flowrep.agent.cuda_graph import WARM_UP, OfOneShape, as_cuda_graph
from tests.agent.tape import Foreign, Tape

ENVS, BATCHES = 5, 7


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
    watch = agent.divergence
    return agent.weights | moments | {"watched": watch._values, "good": watch._good_updates}


@pytest.fixture
def layers_of_cuda(monkeypatch):
    """Layers that are PyTorch's operations alone, as on CUDA; a tape records no others."""
    monkeypatch.setattr(layers, "_is_shared_out", lambda x: False)


class Taped:
    """Stands in for a CUDA graph: some steps as they are, one on tape, the rest from the tape."""

    def __init__(self, step):
        self.step, self.calls, self.tape = step, 0, Tape()

    def __call__(self, batch):
        self.calls += 1
        if self.calls < WARM_UP:
            return self.step(batch)
        if self.calls == WARM_UP:
            static = batch.clone()
            self.inputs = static.copy()
            with self.tape:
                self.out = self.step(static)
        else:
            self.inputs.update_(batch)
            self.tape.replay()
        return self.out.clone()


@pytest.mark.slow_after_first
@pytest.mark.usefixtures("layers_of_cuda")
def test_an_update_from_the_tape_is_the_update(make_any, random_steps):
    eager, taped = make_any(learning_rate=0.01), make_any(learning_rate=0.01)
    batches = batches_of([eager, taped], random_steps)
    taped._step = Taped(taped._take_step)
    for batch in batches:
        expected, actual = eager.update(batch.clone()), taped.update(batch.clone())
        assert expected.keys() == actual.keys()
        differing = [n for n in expected if not torch.equal(expected[n], actual[n])]
        assert [n for n in differing if not expected[n].isnan()] == []
    expected, actual = state_of(eager), state_of(taped)
    assert [name for name in expected if not torch.equal(expected[name], actual[name])] == []


@pytest.mark.slow_after_first
@pytest.mark.usefixtures("layers_of_cuda")
def test_a_loss_that_is_no_number_stops_the_weights_on_tape_too(make_any, random_steps):
    agent = make_any()
    batches = batches_of([agent], random_steps)
    agent._step = Taped(agent._take_step)
    for batch in batches[:5]:
        agent.update(batch.clone())
    before = {name: weight.clone() for name, weight in agent.trained.items()}
    bad = batches[5].clone()
    for key in (("next", "reward"), "advantage", "value_target"):
        if key in bad.keys(True):
            bad[key] = torch.full_like(bad[key], torch.nan)
    agent.update(bad)
    agent.update(batches[6].clone())
    assert [n for n, w in agent.trained.items() if not torch.equal(w, before[n])] == []
    with pytest.raises(ArithmeticError, match="in update 6"):
        agent.divergence.check()


def on_a_device_that_cannot_be_read(make_any):
    """An agent on "meta", which has shapes and no numbers, as good as a GPU that must not wait."""
    reads = {"item": lambda _: 0.5, "is_set_to": lambda *_: False, "__bool__": lambda _: True}
    with patch.multiple(Tensor, **reads):  # TorchRL looks into the weights when it is set up
        return make_any(device="meta")


def take_losses(agent, batch):
    losses = agent.losses(batch)
    torch.stack([x for name, x in losses.items() if name.endswith("_loss")]).sum().backward()
    agent._gradient_norm()
    agent.after_update()


def test_an_update_asks_the_device_for_no_number_and_brings_it_none(make_any, random_steps):
    batch = batches_of([make_any()], random_steps)[0].to("meta")
    agent = on_a_device_that_cannot_be_read(make_any)
    assert agent.CAPTURABLE
    take_losses(agent, batch.copy())  # TorchRL brings its discount when it is first used
    with Foreign() as foreign:
        take_losses(agent, batch.copy())
    assert foreign.crossings == []


def test_on_a_cpu_a_step_stays_what_it_is():
    assert as_cuda_graph(len, torch.device("cpu")) is len


def test_an_algorithm_can_be_told_to_leave_graphs_alone(make_any):
    with patch("flowrep.agent.algorithm.as_cuda_graph", return_value=len):  # as on CUDA
        agent = make_any()
        assert agent._step is len
        agent.step_eagerly()
        assert agent._step == agent._take_step
        agent.load_state_dict(agent.state_dict())
        assert agent._step == agent._take_step


def test_a_batch_unlike_the_first_is_refused_by_name():
    step = OfOneShape(lambda batch: batch)
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
def test_a_graph_on_cuda_equals_the_steps_it_replaces(make_any, random_steps):
    eager, graph = make_any(device="cuda"), make_any(device="cuda")
    batches = batches_of([eager, graph], random_steps)
    eager.step_eagerly()
    for batch in batches:
        expected, actual = eager.update(batch.clone()), graph.update(batch.clone())
        for name, value in expected.items():
            torch.testing.assert_close(actual[name], value, rtol=1e-3, atol=1e-4, equal_nan=True)
    for name, value in state_of(eager).items():
        torch.testing.assert_close(state_of(graph)[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_an_agent_on_cuda_resumes_into_a_graph_of_its_own(make_any, random_steps):
    whole, resumed = make_any(device="cuda"), make_any(device="cuda", seed=9)
    batches = batches_of([whole, resumed], random_steps)
    for batch in batches[:5]:
        whole.update(batch.clone())
        resumed.update(batch.clone())
    resumed.load_state_dict(whole.state_dict())
    for batch in [*batches[5:], *batches[:5]]:
        whole.update(batch.clone())
        resumed.update(batch.clone())
    for name, weight in whole.weights.items():
        torch.testing.assert_close(resumed.weights[name], weight, rtol=1e-3, atol=1e-4)
