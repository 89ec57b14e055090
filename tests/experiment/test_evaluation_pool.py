"""Episodes in several processes: the same ones, and how they end."""

import os
import signal
from functools import partial

import pytest

pytest.importorskip("pybullet", reason="policies drive the simulated street")

from flowrep.envs import WorkerError, make_env
from flowrep.experiment.evaluation import Comparison, evaluate
from flowrep.experiment.evaluation_pool import EvaluationPool, can_travel
from tests.experiment.test_evaluation import (
    ASKED,
    Weigher,
    episodes,
    outcomes,
    scene,
    straight_on,
    weigher,
)

pytestmark = pytest.mark.slow
__all__ = ["scene"]


@pytest.fixture(scope="module")
def pool():
    """Its processes take seconds to start."""
    made = EvaluationPool(2)
    yield made
    made.close()


def test_several_processes_give_the_rows_of_one(scene, pool):
    make = partial(make_env, scene, representations=["obj"])
    rows = []
    few = ASKED | {"fps": [12], "episodes": 2}
    for where in (pool, None):
        asked = Comparison(**few, policies=["greedy", "sampled"], baselines=["random"])
        asked.run(make, weigher("obj"), num_envs=4, pool=where)
        assert asked.done == asked.total
        rows.append(asked.rows())
    assert rows[0] == rows[1]


def driven(pool, scene, policy, stop=None, count=4):
    make = partial(make_env, scene, representations=["obj"])
    jobs = {"greedy": {"policy": policy, "episodes": episodes(count)}}
    return [episode for _, episode in pool.evaluate(make, 4, jobs, stop)]


def test_each_evaluation_reads_the_weights_of_that_moment(scene, pool):
    env, policy = make_env(scene, ["obj"], num_envs=2), weigher("obj")
    found = []
    for _ in range(2):
        found.append(outcomes(driven(pool, scene, policy)))
        assert found[-1] == outcomes(evaluate(env, policy, episodes(4)))
        (network,) = (module for module in policy.modules() if isinstance(module, Weigher))
        network.factor.data += 2.0
    env.close()
    assert found[0] != found[1]


def test_a_stop_ends_the_shares_under_way(scene, pool):
    assert driven(pool, scene, weigher("obj"), stop=True, count=400) == []


def test_only_networks_that_can_be_copied_travel():
    assert can_travel(weigher("obj"))
    assert not can_travel(straight_on)
    unknown = weigher("obj")
    unknown.function = lambda tensordict: tensordict
    assert not can_travel(unknown)


def test_a_process_that_was_killed_is_told_and_ctrl_c_is_not_heard(scene, pool):
    """The last test of these processes."""
    assert len(driven(pool, scene, "never_turn")) == 4
    processes = list(pool._executor._processes)
    for process in processes:
        os.kill(process, signal.SIGINT)
    assert len(driven(pool, scene, "never_turn")) == 4
    os.kill(processes[0], signal.SIGKILL)
    with pytest.raises(WorkerError, match="memory"):
        driven(pool, scene, weigher("obj"))
