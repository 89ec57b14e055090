import platform

import pytest
import torch

from flowrep.agent import cpu, torch_threads
from tests.running import run_python

COUNT_PAGE_FAULTS = """
import resource, runpy, sys, types
sys.modules["torch"] = types.ModuleType("torch")  # has no part in it and takes seconds to import
keep_freed_memory = runpy.run_path(sys.argv[1])["keep_freed_memory"]
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
    result = run_python("-c", COUNT_PAGE_FAULTS, cpu.__file__, check=True)
    by_default, kept = map(int, result.stdout.split())
    assert kept < 0.1 * by_default


def test_torch_has_so_many_threads_inside_and_as_many_as_before_afterwards():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    with pytest.raises(ZeroDivisionError), torch_threads(before + 2):
        raise ZeroDivisionError
    assert torch.get_num_threads() == before
