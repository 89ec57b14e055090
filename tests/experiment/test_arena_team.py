"""Arenas in several processes: what they share, how they fail and end."""

import os
import signal
from typing import ClassVar

import pytest
import torch
from torch import nn

pytest.importorskip("pybullet", reason="policies drive the simulated street")

from flowrep.agent.networks import DiscreteActions, stochastic_policy
from flowrep.envs import WorkerError
from flowrep.exchange.policies import ForeignPolicy
from flowrep.experiment import build
from flowrep.experiment.arena import Agent, Job
from flowrep.experiment.arena_team import ArenaTeam, can_travel
from flowrep.experiment.build import ENVS_PER_ARENA
from flowrep.scenes import load_scene
from tests.config.composing import composed

pytestmark = pytest.mark.slow

ACTIONS = DiscreteActions(3, "categorical", torch.distributions.Categorical)
JOBS = [Job(0, True, "low", 12.0, seed) for seed in range(6)]
STRAIGHT_ON, LEFT = 0, 1


class Leaning(nn.Module):
    """Always prefers one action, which is its weight."""

    threads: ClassVar[set[int]] = set()  # with which this process called it

    def __init__(self, action):
        super().__init__()
        self.action = nn.Parameter(torch.tensor(float(action)))

    def forward(self, maps):
        self.threads.add(torch.get_num_threads())
        return -(torch.arange(3.0) - self.action).abs().expand(len(maps), 3)


@pytest.fixture(scope="module")
def config():
    return composed("scene.camera.height_px=12", "scene.camera.width_px=20", "num_workers=2")


@pytest.fixture(scope="module")
def scene(config):
    return load_scene(config.scene)


def leaning(action):
    return Agent(stochastic_policy(Leaning(action), ["depth"], ACTIONS), {"depth": {}})


@pytest.fixture(scope="module")
def team(scene):
    made = []

    def make(*agents):
        made.append(ArenaTeam(scene, agents, num_envs=3, num_processes=3))
        return made[-1]

    yield make
    for arena in made:
        arena.close()


@pytest.fixture(scope="module")
def to_the_left(team):
    """Has driven, so that its processes have begun."""
    arena = team(leaning(LEFT))
    list(arena.run(JOBS))
    return arena


def test_each_run_reads_the_weights_of_that_moment(team):
    agent = leaning(LEFT)
    arena = team(agent)
    before = dict(arena.run(JOBS))
    assert before.keys() == set(range(len(JOBS)))
    assert {episode.outcome for episode in before.values()} == {"out_of_bounds"}
    with torch.no_grad():
        agent.policy.get_parameter("module.0.module.action").fill_(STRAIGHT_ON)
    after = dict(arena.run(JOBS))
    assert [after[k].episode_seed for k in range(6)] == [before[k].episode_seed for k in range(6)]
    straight_on = dict(team(leaning(STRAIGHT_ON)).run(JOBS))
    assert after == straight_on != before


def test_this_process_drives_too_on_one_thread(to_the_left):
    before = torch.get_num_threads()
    Leaning.threads.clear()
    try:
        torch.set_num_threads(3)
        list(to_the_left.run(JOBS))
        assert (Leaning.threads, torch.get_num_threads()) == ({1}, 3)
    finally:
        torch.set_num_threads(before)


def test_baselines_get_their_jobs_numbers(to_the_left):
    jobs = [("never_turn", {"episode_seed": seed, "speed": "low"}) for seed in range(5)]
    drives = dict(to_the_left.drive(jobs))
    assert {k: drive.episode_seed for k, drive in drives.items()} == {k: k for k in range(5)}


def test_a_process_that_was_killed_is_named_and_the_rest_ends(team):
    arena = team(leaning(LEFT))
    list(arena.run(JOBS))
    processes = [worker.process.pid for worker in arena._group.workers]
    os.kill(processes[1], signal.SIGKILL)
    with pytest.raises(WorkerError, match=r"arena 1 is gone \(SIGKILL\)"):
        list(arena.run(JOBS))
    with pytest.raises(WorkerError, match="have ended"):
        list(arena.run(JOBS))


def test_what_was_left_unfinished_is_not_in_the_next_run(to_the_left):
    next(to_the_left.run(JOBS))
    assert dict(to_the_left.run(JOBS[:4])).keys() == {0, 1, 2, 3}


def test_only_what_can_be_sent_to_a_process_is(config):
    agent = leaning(LEFT)
    many, few = 2 * ENVS_PER_ARENA, 2 * ENVS_PER_ARENA - 1
    arena = build.arena(config, [agent], many)
    assert isinstance(arena, ArenaTeam)
    arena.close()
    assert can_travel([agent])
    assert not can_travel([agent._replace(device="cuda")])
    assert not can_travel([agent._replace(policy=lambda maps: maps)])
    assert not can_travel([agent, Agent(ForeignPolicy("mine", print, None), {"depth": {}})])
    in_one = config.model_copy(update={"num_workers": 0})
    stays = agent._replace(policy=lambda maps: maps)
    for arena in (
        build.arena(config, [agent], few),
        build.arena(in_one, [agent], many),
        build.arena(config, [stays], many),
    ):
        assert not isinstance(arena, ArenaTeam)
        arena.close()
