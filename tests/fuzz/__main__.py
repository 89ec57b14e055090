"""Throws odd inputs at flowrep: python -m tests.fuzz --parts recordings --mutations 10000.

`--only NUMBER` shows and runs one input again.
"""

import argparse
import importlib
import sys
from pathlib import Path

from tests.fuzz.framework import Part, case, fuzz

_NO_PARTS = ("__main__", "framework")


def parts() -> dict[str, Part]:
    """Returns the parts by name: every module beside this one that holds a `PART`."""
    stems = sorted(path.stem for path in Path(__file__).parent.glob("*.py"))
    modules = [
        importlib.import_module(f"tests.fuzz.{stem}")
        for stem in stems
        if stem not in _NO_PARTS and not stem.startswith("test_")
    ]
    found = [module.PART for module in modules if hasattr(module, "PART")]
    return {part.name: part for part in found}


def main() -> int:
    known = parts()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", default=list(known), choices=list(known))
    parser.add_argument("--mutations", type=int, default=1000, help="of each part")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="the number of one input")
    args = parser.parse_args()
    numbers = range(args.mutations) if args.only is None else range(args.only, args.only + 1)
    failed = 0
    for name in args.parts:
        if args.only is not None:
            print(case(known[name], args.seed, args.only))
        tally = fuzz(known[name], numbers, args.seed)
        for number, trace in tally.failures[:20]:
            print(f"{name} {number}: {trace}", flush=True)
        counts = ", ".join(f"{count} {outcome}" for outcome, count in tally.outcomes.most_common())
        seconds, slowest = tally.slowest
        print(f"{name}: {counts}; the slowest, number {slowest}, took {seconds:.1f} s", flush=True)
        failed += len(tally.failures)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
