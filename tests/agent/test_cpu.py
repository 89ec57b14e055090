import platform
import subprocess
import sys

import pytest
import torch

from flowrep.agent import FasterThreads, cpu

COUNT_PAGE_FAULTS = """
import resource
from flowrep.agent import keep_freed_memory
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
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
    command = [sys.executable, "-c", COUNT_PAGE_FAULTS]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    by_default, kept = map(int, result.stdout.split())
    assert kept < 0.1 * by_default


@pytest.fixture
def clock(monkeypatch):
    """A clock on which an update takes as many seconds as `seconds` says for its threads."""
    seconds, now = {}, [0.0]

    def read():
        now[0] += seconds.get(torch.get_num_threads(), 0.0) / 2
        return now[0]

    monkeypatch.setattr(cpu.time, "perf_counter", read)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield seconds
    torch.set_num_threads(before)


def test_updates_take_the_number_of_threads_that_was_faster_of_late(clock):
    threads, used = FasterThreads(2), []
    for seconds in ({1: 3.0, 2: 2.0}, {1: 3.0, 2: 7.0}, {1: 3.0, 2: 2.0}):  # idle, busy, idle
        clock.update(seconds)
        for _ in range(cpu.PERIOD):
            with threads:
                used.append(torch.get_num_threads())
            assert torch.get_num_threads() == 1  # as before
    later = [set(used[i * cpu.PERIOD + 2 * cpu.TRIALS : (i + 1) * cpu.PERIOD]) for i in range(3)]
    assert later == [{2}, {1}, {2}]
    assert used[: 2 * cpu.TRIALS] == [1, 2] * cpu.TRIALS
