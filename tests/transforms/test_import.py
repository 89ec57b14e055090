"""The transforms are a library: what they import is torch, tensordict and torchrl."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys
import torch, tensordict.nn, torchrl.data, torchrl.envs.transforms
before = {name.partition(".")[0] for name in sys.modules}
import flowrep.transforms
after = {name.partition(".")[0] for name in sys.modules}
print(*sorted(after - before - sys.stdlib_module_names))
"""


@pytest.mark.slow
def test_importing_the_transforms_imports_nothing_else():
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    assert result.stdout.split() == ["flowrep"]
