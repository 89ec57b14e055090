import platform
import subprocess
import sys

import pytest

from flowrep.agent import allocator

# the module's own file, so that counting needs no import of torch
COUNT_PAGE_FAULTS = """
import resource, runpy, sys
if sys.argv[1] == "keep":
    assert runpy.run_path(sys.argv[2])["keep_freed_memory"]()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        bytearray(b"x") * 80_000_000  # some 20,000 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator")
def test_a_freed_block_is_reused_without_page_faults():
    faults = {}
    for mode in ("default", "keep"):
        command = [sys.executable, "-c", COUNT_PAGE_FAULTS, mode, allocator.__file__]
        result = subprocess.run(command, capture_output=True, text=True, check=True)
        faults[mode] = int(result.stdout)
    assert faults["keep"] < 0.1 * faults["default"]


def test_another_c_library_is_left_alone(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    assert allocator.keep_freed_memory() is False
