import math

import pytest
import torch

from flowrep.agent.divergence import DivergenceError, DivergenceWatch


def metrics(**values):
    return {name: torch.tensor(value) for name, value in values.items()}


def test_the_first_bad_update_is_told_with_its_statistics():
    watch = DivergenceWatch(["q_loss", "actor_loss"], ["entropy"])
    watch.look(metrics(q_loss=1.0, actor_loss=2.0, entropy=0.5))
    assert watch.is_bad == 0
    watch.check()
    watch.look(metrics(q_loss=3.0, actor_loss=-math.inf, entropy=0.25))
    assert watch.is_bad == 1
    watch.look(metrics(q_loss=math.nan, actor_loss=math.nan, entropy=9.0))
    assert watch.is_bad == 1
    message = r"^actor_loss became -inf in update 2 \(q_loss=3, actor_loss=-inf, entropy=0.25\)$"
    with pytest.raises(DivergenceError, match=message):
        watch.check()


def test_after_a_reset_updates_are_counted_from_the_given_number():
    watch = DivergenceWatch(["q_loss"])
    is_bad = watch.is_bad  # which the optimizer holds
    watch.look(metrics(q_loss=math.nan))
    watch.reset(40)
    assert is_bad == 0
    watch.check()
    watch.look(metrics(q_loss=1.0))
    watch.look(metrics(q_loss=math.inf))
    assert is_bad == 1
    with pytest.raises(DivergenceError, match=r"^q_loss became inf in update 42 \(q_loss=inf\)$"):
        watch.check()


def test_what_is_logged_beside_the_losses_may_be_undefined():
    watch = DivergenceWatch(["q_loss"], ["explained_variance"])
    watch.look(metrics(q_loss=1.0, explained_variance=math.nan))
    assert watch.is_bad == 0
    watch.check()


def test_looking_reads_nothing_back_from_the_device(monkeypatch):
    """`item`, `tolist` and `bool` are what makes a GPU's host wait."""
    watch = DivergenceWatch(["q_loss"])
    values = metrics(q_loss=1.0)

    def forbidden(*_):
        raise AssertionError("the host would have to wait here")

    with monkeypatch.context() as patched:
        for name in ("item", "tolist", "__bool__", "__float__", "__int__", "numpy"):
            patched.setattr(torch.Tensor, name, forbidden)
        watch.look(values)
        with pytest.raises(AssertionError, match="have to wait"):
            watch.check()
