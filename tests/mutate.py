"""Breaks flowrep in a sample of places, one at a time, and shows the breaks that no test notices.

python -m tests.mutate geometry --sample 60

mutmut writes the breaks and runs the tests; all of it happens in a copy below build/mutants.
"""

import argparse
import difflib
import json
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("flowrep", "conf", "tests", "docs", "pyproject.toml", "README.md", "CONVENTIONS.md")
TESTS = "not slow or slow_after_first"  # with all of their cases
_NO_TESTS = "none.such"
_NOTICED = ("🎉", "⏰")  # a test failed, or ran on and on


class Target(NamedTuple):
    """What is broken, and which tests should notice: options of pytest.

    mutmut's own code is in the way of a compiler's, and is one more import: tests of those are left
    out.
    """

    files: str
    tests: tuple[str, ...]


TARGETS = {
    "geometry": Target(
        "flowrep/geometry/*.py",
        ("tests/geometry", "--ignore=tests/geometry/test_export.py", "-k", "not compile"),
    ),
    "transforms": Target(
        "flowrep/transforms/*.py",
        ("tests/transforms", "--ignore=tests/transforms/test_import.py", "-k", "not compile"),
    ),
    "agent": Target("flowrep/agent/*.py", ("tests/agent", "-k", "not compile and not captured")),
    "episode": Target(
        "flowrep/envs/episode.py",
        ("tests/envs/test_street_env.py", "tests/baselines/test_scenes.py", "-k", "not checks"),
    ),
}


def copy_to(folder: Path, target: Target) -> None:
    """Writes what mutmut reads."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(source, folder / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(source, folder / name)
    settings = {
        "source_paths": ["flowrep"],
        "only_mutate": [target.files],
        "also_copy": [name for name in COPIED if name != "flowrep"],
        "pytest_add_cli_args": ["-p", "no:cacheprovider", "-n0", "-m", TESTS],
        "pytest_add_cli_args_test_selection": list(target.tests),
    }
    text = "".join(
        f"{key}=\n" + "".join(f"    {v}\n" for v in values) for key, values in settings.items()
    )
    (folder / "setup.cfg").write_text(f"[mutmut]\n{text}")


def mutmut(folder: Path, *names: str) -> str:
    """Runs mutants by name; returns what it printed."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *names]
    return subprocess.run(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ).stdout


def all_mutants(folder: Path) -> list[str]:
    """Returns the names of all that mutmut wrote."""
    files = sorted((folder / "mutants").rglob("*.meta"))
    return sorted(name for f in files for name in json.loads(f.read_text())["exit_code_by_key"])


def what_is_broken(folder: Path, mutant: str) -> Iterator[str]:
    """Yields the lines that a mutant changes."""
    module, function = mutant.rsplit(".", 1)
    code = (folder / "mutants" / (module.replace(".", "/") + ".py")).read_text()
    whole, broken = (
        re.search(rf"^( *)def {re.escape(name)}\(.*?(?=^\1[^\s)]|\Z)", code, re.S | re.M)
        for name in (re.sub(r"_mutmut_\d+$", "_mutmut_orig", function), function)
    )
    if whole is None or broken is None:
        return
    lines = [found.group().splitlines()[1:] for found in (whole, broken)]
    for line in difflib.unified_diff(*lines, n=0, lineterm=""):
        if not line.startswith(("---", "+++", "@@")):
            yield line


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=list(TARGETS))
    parser.add_argument("--sample", type=int, default=60)
    parser.add_argument("--seed", type=int, default=2026)
    args = parser.parse_args()
    folder = ROOT / "build" / "mutants" / args.target
    copy_to(folder, TARGETS[args.target])
    printed = mutmut(folder, _NO_TESTS)
    names = all_mutants(folder)
    if not names:
        print(printed[-2000:])
        return 1
    random.Random(args.seed).shuffle(names)
    chosen = names[: args.sample]
    printed = mutmut(folder, *chosen)
    results = dict(
        line.split()[::-1] for line in printed.splitlines() if line.endswith(tuple(chosen))
    )
    if len(results) < len(chosen):
        print(printed[-2000:])
        return 1
    survivors = sorted(name for name, result in results.items() if result not in _NOTICED)
    for name in survivors:
        print(name, *what_is_broken(folder, name), sep="\n    ")
    print(
        f"{args.target}: {len(chosen) - len(survivors)} of {len(chosen)} were noticed, drawn from "
        f"{len(names)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
