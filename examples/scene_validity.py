"""Checks that scenes are fair tasks: the planner reaches the end zone, simple baselines don't.

python examples/scene_validity.py --scenes straight_road --episodes 500
"""

import argparse
import time
from collections import Counter

from flowrep.baselines import BaselinePolicy
from flowrep.envs import make_env
from flowrep.experiment.evaluation import evaluate
from flowrep.experiment.outcomes import OUTCOMES, wilson_interval
from flowrep.scenes import load_scene, scene_names

BOUNDS = {"planner": (0.95, 1.0), "never_turn": (0.0, 0.15), "random": (0.0, 0.05)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--baselines", nargs="+", default=list(BOUNDS), choices=list(BOUNDS))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(
        f"{'scene':<20}{'speed':<8}{'baseline':<12}", *(f"{name:<19}" for name in OUTCOMES), "valid"
    )
    for name in args.scenes:
        scene = load_scene(name)
        for speed in scene.pedestrian_speed_mps:
            for baseline in args.baselines:
                started = time.perf_counter()
                env = make_env(scene, speed=speed, num_envs=16)
                seeds = range(args.seed, args.seed + args.episodes)
                episodes = [{"episode_seed": seed} for seed in seeds]
                ended = evaluate(env, BaselinePolicy(baseline), episodes)
                counts = Counter(episode.outcome for episode in ended)
                env.close()
                cells = [cell(counts[outcome], args.episodes) for outcome in OUTCOMES]
                low, high = BOUNDS[baseline]
                is_valid = low <= counts["success"] / args.episodes <= high
                seconds = time.perf_counter() - started
                row = f"{scene.name:<20}{speed:<8}{baseline:<12}"
                print(row, *cells, "yes" if is_valid else "NO", f"({seconds:.0f} s)", flush=True)


def cell(count: int, episodes: int) -> str:
    low, high = wilson_interval(count, episodes)
    return f"{f'{100 * count / episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}]':<19}"


if __name__ == "__main__":
    main()
