"""Compares the cost of flow with that of rendering the depth and ids that it needs, in Newton.

    python benchmarks/rendered_flow.py [--worlds 1 16] [--rounds 30]

A step with flow, a step without it, and the rendering alone take turns. Times are medians of CPU
times of one thread; flow's is the difference between the two steps, adapters included.
"""

import argparse
import statistics
import time

import torch

from examples.newton_flow import HEIGHT, WIDTH, make_env


def cpu_ms(call) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


def compare(worlds: int, rounds: int) -> str:
    env = make_env(worlds)
    td = env.reset().set("action", torch.zeros(worlds, 1))
    env.step(td), env.base_env.step(td)  # compiles Warp's kernels
    times = [
        (cpu_ms(env.base_env.render), cpu_ms(lambda: env.base_env.step(td)),
         cpu_ms(lambda: env.step(td)))
        for _ in range(rounds)
    ]  # fmt: skip
    render, without, step = (statistics.median(column) for column in zip(*times))
    flow = step - without
    return f"| {worlds} | {render:.1f} ms | {flow:.1f} ms | {flow / render:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{WIDTH} x {HEIGHT} pixels per world")
    print("| worlds | rendering | flow | ratio |\n| --- | --- | --- | --- |")
    for worlds in args.worlds:
        print(compare(worlds, args.rounds))


if __name__ == "__main__":
    main()
