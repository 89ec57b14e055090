"""Run folders without a training: configs and tables, with as many successes as a test asks for."""

import yaml

from flowrep.experiment.outcomes import COLUMNS
from flowrep.files import write_rows


def config_of(scene="straight_road", stack="ego+obj", seed=0, **changes):
    """A run's config, as little of it as a report reads."""
    speeds = {"low": [0.6, 1], "normal": [1.2, 1.8], "high": [2, 2.4]}
    config = {
        "seed": seed, "device": "cpu", "speed": "normal", "total_frames": 1000, "num_envs": 2,
        "representations": {name: {} for name in stack.split("+")},
        "flow": {"source": "exact"}, "motion": "exact",
        "noise": {"depth_sigma_per_m": 0.0, "drift_m": 0.0},
        "scene": {
            "name": scene, "frame_rate_hz": 12.0, "pedestrian_speed_mps": speeds,
            "time_limit_steps": {"straight_road": 200}.get(scene, 250),
            "camera": {"height_px": 48, "width_px": 64},
        },
        "algorithm": {"_target_": "flowrep.agent.DiscreteSAC", "tau": 0.02},
    }  # fmt: skip
    for key, value in changes.items():
        *places, last = key.split("__")
        section = config
        for place in places:
            section = section[place]
        section[last] = value
    return config


def rows_of(config, outcomes, *, speed="normal", fps=12.0, policy="greedy", **changes):
    """Rows of evaluation.csv, what a report reads of it: episode k is that of seed 100 + k.

    Args:
        outcomes: a letter an episode: s(uccess), c(ollision), o(ut of bounds), t(ime-out).
    """
    names = {"s": "success", "c": "collision", "o": "out_of_bounds", "t": "timeout"}
    same = {"scene": config["scene"]["name"], "frames": config["total_frames"]}
    same |= {"evaluation": "evaluate", "policy": policy, "speed": speed, "fps": fps}
    same |= {"return": 1.0, "length": 150}
    return [
        same
        | {"episode_seed": 100 + k, "outcome": names[letter]}
        | {"hit": "pedestrian" if letter == "c" else ""}
        | changes
        for k, letter in enumerate(outcomes)
    ]


def write_run(path, config, rows, metrics=()):
    """Writes a run's folder."""
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    write_rows(path / "evaluation.csv", rows, COLUMNS)
    write_rows(path / "metrics.csv", metrics)
    return path


def run_in(folder, name, outcomes=4, **changes):
    """A run whose episodes end as the letters say, by speed or at normal speed, or so many well."""
    config = config_of(**changes)
    if isinstance(outcomes, int):
        outcomes = letters(outcomes)
    of = outcomes if isinstance(outcomes, dict) else {"normal": outcomes}
    rows = [row for speed, ends in of.items() for row in rows_of(config, ends, speed=speed)]
    return write_run(folder / name, config, rows)


def letters(successes, episodes=8, rest="c"):
    """Outcomes of which the first are successes and the others `rest`."""
    return "s" * successes + rest * (episodes - successes)
