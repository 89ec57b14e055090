"""Times `factorize` beside the same maths composed from kornia, and a copy of the same bytes.

Its rivals are kornia's eager API, the same compiled, and a few lines of plain PyTorch, compiled,
which have neither masks nor exact zeros: as in a textbook, by products of matrices, and written out
for each coordinate, so that the compiler fuses them. Of a single frame, the transforms RawFlow and
FlowFactorize are compared with ego flow in plain PyTorch; the bound is eight times its time.

Bounds for the compiled function on a CPU: 30 times as fast as eager kornia, and 70 % of the
machine's copy bandwidth at 28 bytes per pixel (raw and depth are read, ego and obj written; the
mask's byte is not counted). All take turns, so that they run under the same load; a ratio is the
median over the turns. The process keeps freed memory, as in training; otherwise page faults would
dominate.

Then comes a table of `factorize`, compiled with a dynamic batch, for batches of 1 to 4096 and both
sizes, as far as memory suffices. `--device cuda` prints only that table, of a GPU.

python benchmarks/factorize.py --rounds 40
python benchmarks/factorize.py --device cuda
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from flowrep.agent import keep_freed_memory
from flowrep.geometry import factorize
from flowrep.transforms import FlowFactorize, RawFlow

SIZES = [(64, 84, 84), (1, 720, 1280)]
SWEEP_SIZES = [(84, 84), (720, 1280)]
SWEEP_BATCHES = [1, 4, 16, 64, 256, 1024, 4096]
BYTES_PER_PIXEL = 28
KORNIA_BOUND, COPY_BOUND, FRAME_BOUND = 30.0, 0.7, 8.0
LARGE_COPY_BYTES = 512 * 2**20  # read and written together; larger than any cache


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument(
        "--cpu-time",
        action="store_true",
        help="one thread, and CPU time instead of wall time: for a busy machine",
    )
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument(
        "--memory-gib", type=float, help="for the table; by default half of the free memory"
    )
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    if args.device == "cuda":
        sweep(torch.device("cuda"), args.memory_gib, args.rounds, cuda_clock)
        return
    keep_freed_memory()
    torch.set_num_threads(1 if args.cpu_time else args.threads)
    clock = time.process_time if args.cpu_time else time.perf_counter
    single_frame(args.rounds, clock)
    for batch, height, width in SIZES:
        compare(batch, height, width, args.rounds, clock)
    sweep(torch.device("cpu"), args.memory_gib, args.rounds, clock)


def cuda_clock() -> float:
    """Returns the time in seconds after the GPU has finished all its work."""
    torch.cuda.synchronize()
    return time.perf_counter()


def sweep(
    device: torch.device, memory_gib: float | None, rounds: int, clock: Callable[[], float]
) -> None:
    """Prints a table with a row for each batch size that fits into memory."""
    limit = free_bytes(device) / 2 if memory_gib is None else memory_gib * 2**30
    threads = f"{torch.get_num_threads()} CPU threads"
    name = torch.cuda.get_device_name() if device.type == "cuda" else threads
    print(f"\nfactorize, compiled with a dynamic batch, float32, {name}, medians of {rounds}")
    print(f"{'height x width':>14} {'batch':>6} {'ms':>10} {'Mpx/s':>9} {'GB/s':>7} {'of copy':>8}")
    compiled = torch.compile(factorize, fullgraph=True, dynamic=True)
    large = min(LARGE_COPY_BYTES, int(limit) // 8 * 8)
    copy = copier(large, device)
    for height, width in SWEEP_SIZES:
        for batch in SWEEP_BATCHES:
            pixels = batch * height * width
            # Inputs and outputs, and 20 bytes per pixel for the previous call's results, which may
            # not be freed yet.
            needed = pixels * (BYTES_PER_PIXEL + 20)
            if needed > limit:
                print(
                    f"{f'{height} x {width}':>14} {batch:6d} left out: {needed / 2**30:.1f} GiB "
                    f"of {limit / 2**30:.1f} GiB"
                )
                continue
            row(compiled, copy, large, (batch, height, width), device, rounds, clock)


def row(
    compiled: Callable[..., object],
    copy: Callable[[], object],
    copied_bytes: int,
    shape: tuple[int, int, int],
    device: torch.device,
    rounds: int,
    clock: Callable[[], float],
) -> None:
    """Prints the time of one batch size, measured in turns with the copy."""
    batch, height, width = shape
    given = [tensor.to(device) for tensor in inputs(batch, height, width)]
    calls = {"factorize": lambda: compiled(*given), "copy": copy}
    turns = in_turns(calls, rounds, clock)
    moved = batch * height * width * BYTES_PER_PIXEL
    seconds = statistics.median(turns["factorize"])
    scale = moved / copied_bytes
    share = median_ratio([scale * s for s in turns["copy"]], turns["factorize"])
    print(
        f"{f'{height} x {width}':>14} {batch:6d} {1e3 * seconds:10.3f} "
        f"{batch * height * width / seconds / 1e6:9.1f} {moved / seconds / 1e9:7.1f} {share:8.0%}",
        flush=True,
    )


def free_bytes(device: torch.device) -> int:
    """Returns the free memory of the device in bytes."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info()[0]
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    raise RuntimeError("no MemAvailable in /proc/meminfo; give --memory-gib")


def compare(batch: int, height: int, width: int, rounds: int, clock: Callable[[], float]) -> None:
    given = inputs(batch, height, width)
    compiled = torch.compile(factorize, fullgraph=True, dynamic=False)
    kornia_compiled = torch.compile(kornia_factorize, dynamic=False)
    plain_compiled = torch.compile(plain_factorize, fullgraph=True, dynamic=False)
    written_out_compiled = torch.compile(written_out_factorize, fullgraph=True, dynamic=False)
    check_equal(given, compiled)
    pixels = batch * height * width
    calls = {
        "compiled": lambda: compiled(*given),
        "eager": lambda: factorize(*given),
        "kornia": lambda: kornia_factorize(*given),
        "kornia, compiled": lambda: kornia_compiled(*given),
        "plain PyTorch, compiled": lambda: plain_compiled(*given),
        "written out, compiled": lambda: written_out_compiled(*given),
        "copy of the same bytes": copier(pixels * BYTES_PER_PIXEL),
        "copy past the caches": copier(LARGE_COPY_BYTES),
    }
    turns = in_turns(calls, rounds, clock)
    report(f"{batch} x {height} x {width}", pixels * BYTES_PER_PIXEL, turns)


def single_frame(rounds: int, clock: Callable[[], float]) -> None:
    """Prints the time of one 84 x 84 frame, eager, relative to plain ego flow in the same turn."""
    raw, depth, K, motion = (tensor[0] for tensor in inputs(1, 84, 84))
    ids = torch.randint(0, 5, depth.shape, generator=torch.Generator().manual_seed(1))
    motions = motion.repeat(5, 1, 1)
    sensor = {"depth": depth, "instance": ids.to(torch.uint8), "instance_motion": motions}
    td = TensorDict({"sensor": {**sensor, "prev_from_curr": motion}})

    def show(name: str, way: Callable[[], object]) -> None:
        calls = {"way": way, "plain": lambda: plain_factorize(raw, depth, K, motion)}
        ratio = median_ratio(*in_turns(calls, rounds, clock).values())
        print(f"1 x 84 x 84, eager: {name} take {ratio:.1f} x plain ego flow; bound "
              f"{FRAME_BOUND:g}: {verdict(ratio <= FRAME_BOUND)}")  # fmt: skip

    exact, split, one_pass = RawFlow(K), FlowFactorize(K), RawFlow(K, outputs=["ego", "obj"])
    show("RawFlow and FlowFactorize by PyTorch", lambda: split(exact(td)))
    import numba  # noqa: F401  (small maps are left to PyTorch until something loads it)

    show("ego and obj of RawFlow by numba", lambda: one_pass(td))


def plain_factorize(
    raw: Tensor, depth: Tensor, K: Tensor, prev_from_curr: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns ego and obj by the textbook: unproject, move, project."""
    height, width = depth.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).flatten(1)
    points = (K.inverse() @ pixels) * depth.flatten(-2)
    moved = K @ (prev_from_curr[..., :3, :3] @ points + prev_from_curr[..., :3, 3:])
    ego = (pixels[:2] - moved[..., :2, :] / moved[..., 2:, :]).unflatten(-1, (height, width))
    return ego, raw - ego


def written_out_factorize(
    raw: Tensor, depth: Tensor, K: Tensor, prev_from_curr: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns ego and obj as `plain_factorize` does, without products of matrices."""
    z = depth[..., 0, :, :]
    v, u = torch.arange(z.shape[-2])[:, None] + 0.5, torch.arange(z.shape[-1]) + 0.5
    fx, fy, cx, cy = (K[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = (u - cx) / fx * z, (v - cy) / fy * z
    (a, b, c, d), (e, f, g, h), (i, j, k, m) = (
        row[..., None, None].unbind(-3) for row in prev_from_curr[..., :3, :].unbind(-2)
    )
    was_x, was_y, was_z = (
        a * x + b * y + c * z + d,
        e * x + f * y + g * z + h,
        i * x + j * y + k * z + m,
    )
    ego = torch.stack([u - fx * was_x / was_z - cx, v - fy * was_y / was_z - cy], -3)
    return ego, raw - ego


def report(size: str, moved_bytes: int, turns: dict[str, list[float]]) -> None:
    print(
        f"\n{size}, float32, {torch.get_num_threads()} threads, medians of {len(turns['kornia'])}"
    )
    for name, seconds in turns.items():
        moved = LARGE_COPY_BYTES if name == "copy past the caches" else moved_bytes
        median = statistics.median(seconds)
        print(f"  {name:24} {1e3 * median:9.3f} ms  {moved / median / 1e9:6.1f} GB/s")
    scale = moved_bytes / LARGE_COPY_BYTES
    for rival in ("kornia, compiled", "plain PyTorch, compiled", "written out, compiled"):
        print(f"  compiled is {median_ratio(turns[rival], turns['compiled']):.1f} x {rival}")
    kornia = median_ratio(turns["kornia"], turns["compiled"])
    kornia_eager = median_ratio(turns["kornia"], turns["eager"])
    same = median_ratio(turns["copy of the same bytes"], turns["compiled"])
    large = median_ratio([scale * s for s in turns["copy past the caches"]], turns["compiled"])
    print(
        f"  compiled is {kornia:.1f} x kornia (eager {kornia_eager:.1f} x); bound "
        f"{KORNIA_BOUND:g}: {verdict(kornia >= KORNIA_BOUND)}"
    )
    print(
        f"  and at {100 * large:.0f} % of the machine's copy bandwidth; bound "
        f"{100 * COPY_BOUND:g} %: {verdict(large >= COPY_BOUND)}"
    )
    print(f"  and at {100 * same:.0f} % of a copy of the same bytes, which may stay in the cache")


def in_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float]
) -> dict[str, list[float]]:
    """Returns the seconds of each call in each round, in which all take turns."""
    repeats = {name: repeats_for(call, clock) for name, call in calls.items()}
    turns: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            turns[name].append(timed(call, repeats[name], clock))
    return turns


def verdict(held: bool) -> str:
    return "ok" if held else "TOO SLOW"


def median_ratio(slow: list[float], fast: list[float]) -> float:
    # Of the ratios of single turns: within a turn, the machine's load is the same for both.
    return statistics.median(s / f for s, f in zip(slow, fast))


def inputs(batch: int, height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns raw, depth, K and prev_from_curr of a turn at 10 m/s and 12 frames/s."""
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(batch, 2, height, width, generator=generator)
    depth = 2 + 60 * torch.rand(batch, 1, height, width, generator=generator)
    focal = height / 2
    K = torch.tensor([[focal, 0, width / 2], [0, 1.01 * focal, height / 2], [0, 0, 1.0]])
    yaw = 0.02
    prev_from_curr = torch.tensor(
        [
            [math.cos(yaw), 0, math.sin(yaw), 0.02],
            [0, 1, 0, 0.01],
            [-math.sin(yaw), 0, math.cos(yaw), 0.83],
            [0, 0, 0, 1],
        ]
    )
    return raw, depth, K.repeat(batch, 1, 1), prev_from_curr.repeat(batch, 1, 1)


def kornia_factorize(
    raw: Tensor, depth: Tensor, K: Tensor, prev_from_curr: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns ego and obj by kornia's unproject, transform and project.

    Its pixel centres are at integers, so K's principal point is shifted by half a pixel.
    """
    from kornia.geometry import create_meshgrid
    from kornia.geometry import depth as kornia_depth
    from kornia.geometry.camera import project_points
    from kornia.geometry.linalg import transform_points

    half = torch.zeros_like(K)
    half[:, :2, 2] = 0.5
    K = K - half
    height, width = depth.shape[-2:]
    points = kornia_depth.depth_to_3d_v2(depth[:, 0], K)  # [B, H, W, 3]
    previous = transform_points(prev_from_curr[:, None], points)
    pixels = create_meshgrid(height, width, normalized_coordinates=False, device=depth.device)
    flow = pixels - project_points(previous, K[:, None, None])
    ego = flow.permute(0, 3, 1, 2)
    return ego, raw - ego


def check_equal(given: tuple[Tensor, ...], compiled: Callable[..., tuple[Tensor, ...]]) -> None:
    """Raises AssertionError unless all three agree, up to kornia's float32 error."""
    exact = kornia_factorize(*(tensor.double() for tensor in given))
    rivals = (written_out_factorize, kornia_factorize)
    for factors in (compiled(*given), factorize(*given), *(each(*given) for each in rivals)):
        for part, expected in zip(factors[:2], exact):
            torch.testing.assert_close(part.double(), expected, rtol=1e-5, atol=1e-3)
    assert factorize(*given).valid.all()


def copier(moved_bytes: int, device: torch.device | str = "cpu") -> Callable[[], object]:
    """Returns a call that copies half of `moved_bytes`: each byte is read and written."""
    source = torch.rand(moved_bytes // 8, device=device)
    target = torch.empty_like(source)
    return lambda: target.copy_(source)


def repeats_for(
    call: Callable[[], object], clock: Callable[[], float], turn_s: float = 0.02
) -> int:
    timed(call, 3, clock)
    return max(2, round(turn_s / timed(call, 3, clock)))


def timed(call: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    """Returns seconds per call, without the turn's first call, whose data isn't in the cache."""
    call()
    started = clock()
    for _ in range(repeats):
        call()
    return (clock() - started) / repeats


if __name__ == "__main__":
    main()
