import os
import signal
import subprocess
import sys
import time
from copy import deepcopy
from functools import partial
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from flowrep.envs import WorkerError, WorkerVectorEnv, workers
from tests.comparing import differing
from tests.running import ENVIRONMENT

pytestmark = pytest.mark.slow


class Counter(gym.Env):
    """Counts on from its seed; an action of 9 ends the episode, one of 13 is a mistake."""

    observation_space = spaces.Dict(
        count=spaces.Box(0, 1 << 30, (2,), np.int64),
        inner=spaces.Dict(picture=spaces.Box(0, 255, (3, 4), np.uint8)),
    )
    action_space = spaces.Discrete(20)

    def __init__(self, number=0):
        self.number, self.count = number, 0

    def observation(self):
        picture = np.full((3, 4), self.count % 251, np.uint8)
        return {"count": np.array([self.number, self.count]), "inner": {"picture": picture}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = int(self.np_random.integers(1000)) + (options or {}).get("add", 0)
        return self.observation(), {}

    def step(self, action):
        if action == 13:
            raise ZeroDivisionError(f"unlucky environment {self.number}")
        if action == 17:
            os.kill(os.getpid(), signal.SIGKILL)
        self.count += int(action)
        return self.observation(), self.count / 4, action == 9, action == 8, {}


def factories(num_envs):
    return [partial(Counter, i) for i in range(num_envs)]


@pytest.fixture
def make(close_later):
    return lambda envs, workers: close_later(WorkerVectorEnv(factories(envs), workers))


def in_process(num_envs):
    return SyncVectorEnv(factories(num_envs), autoreset_mode=AutoresetMode.DISABLED)


def test_workers_equal_gymnasiums_sync_vector_env(make):
    ours, theirs = make(5, 3), in_process(5)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    both = (ours, theirs)
    begun, other = (env.reset(seed=3) for env in both)
    kept = deepcopy(begun)
    assert differing(begun, other) == []
    assert differing(*(env.step(np.array([9, 1, 2, 8, 3])) for env in both)) == []
    masked = {"reset_mask": np.array([True, False, False, True, False]), "add": 5}
    assert differing(*(env.reset(options=dict(masked)) for env in both)) == []
    assert differing(*(env.step(np.arange(5)) for env in both)) == []
    assert differing(*(env.reset(seed=[7, 7, 1, 2, 3]) for env in both)) == []
    assert differing(*(env.reset() for env in both)) == []
    assert differing(*(env.call("step", 2) for env in both)) == []
    assert differing(*(env.call("reset", options={"add": 5}) for env in both)) == []
    assert ours.call("number") == (0, 1, 2, 3, 4)
    assert differing(begun, kept) == []  # what was returned belongs to the caller


def test_a_step_begun_early_is_returned_later_or_dropped_by_a_reset(make):
    ours, theirs = make(3, 2), in_process(3)
    for env in (ours, theirs):
        env.reset(seed=0)
    for actions in (np.array([1, 2, 3]), np.array([5, 6, 0])):
        ours.step_async(actions)
        assert differing(ours.step(actions), theirs.step(actions)) == []
    ours.step_async(actions)
    with pytest.raises(RuntimeError, match="a step is under way"):
        ours.step_async(actions)
    with pytest.raises(ValueError, match=r"\[5 6 0\].*\[0 6 5\]"):
        ours.step(actions[::-1])
    assert differing(ours.reset(seed=4), theirs.reset(seed=4)) == []
    assert differing(ours.step(actions), theirs.step(actions)) == []


@pytest.mark.parametrize(
    ("action", "told"),
    [
        (13, r"(?s)environments 2 to 3 failed.*unlucky environment 3"),
        (17, r"environments 2 to 3 .*-9.*memory"),
    ],
)
def test_an_error_names_the_envs_of_a_worker_that_failed_or_was_killed(make, action, told):
    env = make(4, 2)
    env.reset(seed=0)
    with pytest.raises(WorkerError, match=told):
        env.step(np.array([1, 1, 1, action]))
    with pytest.raises(WorkerError, match="environments 2 to 3 is gone"):
        env.step(np.array([1, 1, 1, 1]))
    env.close()
    with pytest.raises(WorkerError, match="have ended"):
        env.step(np.array([1, 1, 1, 1]))


def test_the_answer_to_an_interrupted_call_is_discarded(make):
    env, other = make(3, 2), in_process(3)
    for each in (env, other):
        each.reset(seed=0)

    def interrupted():
        raise KeyboardInterrupt

    with patch.object(env._workers[1], "receive", interrupted), pytest.raises(KeyboardInterrupt):
        env.step(np.array([1, 2, 3]))
    assert differing(env.reset(seed=1), other.reset(seed=1)) == []
    assert differing(env.step(np.array([1, 2, 3])), other.step(np.array([1, 2, 3]))) == []


def test_a_suspended_worker_is_named_and_killed(make, monkeypatch):
    env = make(4, 2)
    env.reset(seed=0)
    process = env._workers[1].process
    os.kill(process.pid, signal.SIGSTOP)
    monkeypatch.setattr(workers, "PATIENCE_S", 0.5)
    monkeypatch.setattr(workers, "PATIENCE_AT_THE_END_S", 0.5)
    with pytest.raises(WorkerError, match=rf"environments 2 to 3 .*CONT {process.pid}'"):
        env.step(np.array([1, 1, 1, 1]))
    env.close()
    assert process.exitcode == -signal.SIGKILL


HOLDER = """
import sys
from tests.envs.test_workers import Counter
from flowrep.envs import WorkerVectorEnv

env = WorkerVectorEnv([Counter, Counter, Counter], 2)
env.reset(seed=0)
print(*(worker.process.pid for worker in env._workers), flush=True)
if "wait" in sys.argv:
    input()
"""


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="looks into /proc")
@pytest.mark.parametrize("is_killed", [False, True])
def test_no_worker_outlives_its_caller(tmp_path, is_killed):
    script = tmp_path / "holder.py"
    script.write_text(HOLDER)
    command = [sys.executable, str(script), "wait" if is_killed else "end"]
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    options |= {"env": ENVIRONMENT | {"TMPDIR": str(tmp_path)}}
    with subprocess.Popen(command, **options) as holder:
        try:
            workers = [int(pid) for pid in holder.stdout.readline().split()]
            assert len(workers) == 2
            if is_killed:
                assert all(is_running(pid) for pid in workers)
                holder.kill()
            assert holder.wait(timeout=30) == (-signal.SIGKILL if is_killed else 0)
        finally:
            holder.kill()
    deadline = time.monotonic() + 10
    while any(is_running(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(is_running(pid) for pid in workers)
