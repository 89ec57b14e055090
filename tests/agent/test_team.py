import threading
import time

import pytest
import torch

from flowrep.agent import team
from flowrep.agent.team import Team, parts, run_tasks, threads_in_use, use_threads


@pytest.fixture
def threads():
    """Sets the number of threads; puts everything back afterwards."""
    before = torch.get_num_threads()
    yield use_threads
    use_threads(1)
    torch.set_num_threads(before)


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_task_is_carried_out_once(size, count):
    crew, done = Team(size), []
    crew.run(lambda i=i: done.append(i) for i in range(count))
    assert sorted(done) == list(range(count))
    crew.dismiss()


def test_two_threads_work_at_the_same_time():
    crew, meeting, places = Team(2), threading.Barrier(2, timeout=10), []
    crew.run([lambda: places.append(meeting.wait())] * 2)  # each needs the other to go on
    assert sorted(places) == [0, 1]
    crew.dismiss()


@pytest.mark.parametrize("size", [1, 2])
def test_an_error_is_raised_when_all_have_ended(size):
    crew, done = Team(size), []

    def fail():
        raise KeyError("seven")

    with pytest.raises(KeyError, match="seven"):
        crew.run([fail, *(lambda i=i: done.append(i) for i in range(5))])
    assert sorted(done) == [0, 1, 2, 3, 4]
    crew.dismiss()


def test_tasks_build_no_graph_whoever_runs_them():
    crew, weight, seen = Team(2), torch.ones(1, requires_grad=True), []
    meeting = threading.Barrier(2, timeout=10)

    def task():
        meeting.wait()
        seen.append((weight * 2).requires_grad)

    crew.run([task, task])
    assert seen == [False, False]
    assert torch.is_grad_enabled()
    crew.dismiss()


def test_a_task_runs_beside_the_caller_where_there_is_a_second_thread():
    crew, meeting = Team(2), threading.Barrier(2, timeout=10)
    wait = crew.begin(meeting.wait)
    place = meeting.wait()  # nobody else would come
    assert sorted([place, wait()]) == [0, 1]
    crew.dismiss()


@pytest.mark.parametrize("size", [1, 2])
def test_a_task_that_was_begun_has_ended_after_the_wait(size):
    crew, weight = Team(size), torch.ones(1, requires_grad=True)
    wait = crew.begin(lambda: (weight * 2).requires_grad)
    assert wait() is False

    def fail():
        raise KeyError("seven")

    wait = crew.begin(fail)
    with pytest.raises(KeyError, match="seven"):
        wait()
    crew.dismiss()


def test_helpers_end_when_they_are_dismissed():
    before = set(threading.enumerate())  # helpers of other teams may be ending
    crew = Team(3)
    helpers = set(threading.enumerate()) - before
    assert len(helpers) == 2
    crew.dismiss()
    for helper in helpers:
        helper.join(timeout=10)
        assert not helper.is_alive()
    done = []
    crew.run([lambda: done.append(1)])
    assert done == [1]


def test_threads_that_wait_cost_no_processor_time(threads):
    threads(3)
    run_tasks([lambda: torch.randn(300, 300) @ torch.randn(300, 300)] * 6)
    start = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - start < 0.1  # three that spin would burn 0.5 to 1.5 s


def test_an_operation_in_a_team_takes_one_thread_and_several_outside(threads):
    torch.set_num_threads(3)
    threads(2)
    assert threads_in_use() == torch.get_num_threads() == 3
    seen = []
    meeting = threading.Barrier(2, timeout=10)

    def task():
        meeting.wait()
        seen.append((threading.get_ident(), torch.get_num_threads()))

    run_tasks([task, task])
    assert len({ident for ident, _ in seen}) == 2
    assert [count for _, count in seen] == [1, 1]
    assert torch.get_num_threads() == 3
    torch.set_num_threads(1)
    assert threads_in_use() == 2


@pytest.mark.slow_after_first
@pytest.mark.parametrize("encoder", ["shared", "separate"])
def test_the_number_of_threads_changes_no_bit(
    threads, monkeypatch, make_agent, random_steps, as_batch, encoder
):
    # parts of a few images, as a large batch has them
    monkeypatch.setattr("flowrep.agent.layers.CACHE_BYTES", 1 << 16)
    monkeypatch.setattr("flowrep.agent.layers.ROWS", 8)
    torch.set_num_threads(1)  # as in training; PyTorch's own threads do change bits
    steps, weights = random_steps(32), []
    for count in (1, 2, 3):
        threads(count)
        agent = make_agent(encoder=encoder, precision="bf16")
        for _ in range(3):
            agent.update(as_batch(agent, steps))
        weights.append(agent.state_dict()["weights"])
    for other in weights[1:]:
        assert [n for n, w in weights[0].items() if not torch.equal(w, other[n])] == []


def test_a_team_has_one_thread_at_least():
    with pytest.raises(ValueError, match="at least one thread, got size=0"):
        Team(0)


def test_parts_are_alike_and_leave_nothing_out():
    assert parts(10, 4) == [slice(0, 3), slice(3, 6), slice(6, 10)]
    assert parts(8, 8) == [slice(0, 8)]
    assert parts(0, 8) == [slice(0, 0)]
    assert team.parts(3, 1) == [slice(0, 1), slice(1, 2), slice(2, 3)]
