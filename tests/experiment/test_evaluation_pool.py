"""Episodes in several processes: the same ones, and how they end."""

import os
import signal
from functools import partial

import pytest

pytest.importorskip("pybullet", reason="policies drive the simulated street")

from flowrep.envs import WorkerError, make_env
from flowrep.experiment.evaluation import Comparison, evaluate
from flowrep.experiment.evaluation_pool import EvaluationPool, can_travel
from tests.experiment.test_evaluation import ASKED, Weigher, episodes, outcomes, scene, weigher

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
    for where in (pool, None):
        asked = Comparison(**ASKED, policies=["greedy", "sampled"], baselines=["random"])
        asked.run(make, weigher("obj"), num_envs=4, pool=where)
        assert asked.is_complete
        rows.append(asked.rows())
    assert rows[0] == rows[1]


def test_each_evaluation_reads_the_weights_of_that_moment(scene, pool):
    make = partial(make_env, scene, representations=["obj"], num_envs=2)
    env, policy = make(), weigher("obj")
    found = []
    for _ in range(2):
        alone, shared = evaluate(env, policy, episodes(4)), pool.evaluate(make, policy, episodes(4))
        found.append(outcomes(shared))
        assert found[-1] == outcomes(alone)
        (network,) = (module for module in policy.modules() if isinstance(module, Weigher))
        network.factor.data += 2.0
    env.close()
    assert found[0] != found[1]


def test_a_stop_ends_the_shares_under_way(scene, pool):
    asked = Comparison(**ASKED | {"episodes": 400})
    asked.run(
        partial(make_env, scene, representations=["obj"]),
        weigher("obj"),
        num_envs=4,
        should_stop=lambda: True,
        pool=pool,
    )
    assert not asked.is_complete


def test_policies_that_hold_functions_stay_in_this_process():
    assert can_travel(weigher("obj"))
    assert not can_travel(lambda tensordict: tensordict)


def test_a_process_that_was_killed_is_told_and_ctrl_c_is_not_heard(scene, pool):
    """The last test of these processes."""
    make = partial(make_env, scene, representations=["obj"], num_envs=2)
    list(pool.evaluate(make, "never_turn", episodes(4)))
    processes = list(pool._executor._processes)
    for process in processes:
        os.kill(process, signal.SIGINT)
    assert len(list(pool.evaluate(make, "never_turn", episodes(4)))) == 4
    os.kill(processes[0], signal.SIGKILL)
    with pytest.raises(WorkerError, match="memory"):
        list(pool.evaluate(make, weigher("obj"), episodes(4)))
