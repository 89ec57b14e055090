"""Every policy is measured on the same episodes."""

from functools import partial

import pytest
import torch
from rich.console import Console

pytest.importorskip("pybullet", reason="policies drive the simulated street")

from flowrep.envs import make_env
from flowrep.experiment.comparison import compare, print_table, with_origin
from flowrep.experiment.run_folder import EVALUATION_COLUMNS

NO_OP = 0


def straight_on(tensordict):
    return tensordict.set("action", torch.full(tensordict.batch_size, NO_OP))


@pytest.fixture(scope="module")
def rows():
    return compare(
        {"greedy": straight_on},
        partial(make_env, "straight_road", num_envs=3),
        speeds=["low", "high"],
        fps=[12.0],
        episodes=7,
        seed=5,
        baselines=["never_turn", "random"],
    )


def of(rows, policy, speed="low"):
    return sorted(
        (row["episode_seed"], row["outcome"], row["return"], row["length"])
        for row in rows
        if row["policy"] == policy and row["speed"] == speed
    )


def test_a_batched_policy_and_its_baseline_twin_live_through_the_same_episodes(rows):
    assert len(of(rows, "greedy")) == 7
    assert of(rows, "greedy") == of(rows, "never_turn")
    assert of(rows, "greedy", "high") == of(rows, "never_turn", "high")


def test_another_policy_gets_the_same_episodes_and_ends_them_otherwise(rows):
    seeds = [row[0] for row in of(rows, "never_turn")]
    assert len(set(seeds)) == 7
    assert [row[0] for row in of(rows, "random")] == seeds
    assert of(rows, "random") != of(rows, "never_turn")


def test_returns_are_the_papers_rewards(rows):
    for row in rows:
        end = 5.0 if row["outcome"] == "success" else -5.0
        assert row["return"] == pytest.approx(end + 0.01 * row["length"], abs=1e-3)


def test_rows_have_the_columns_of_evaluation_csv(rows):
    config = {
        "scene": {"name": "straight_road"},
        "representations": {"ego": {}, "obj": {}},
        "flow": {"source": "exact"},
        "seed": 4,
    }
    (row, *_) = with_origin(rows, config, frames=100, evaluation="final")
    assert set(row) == set(EVALUATION_COLUMNS)
    assert row["representations"] == "ego+obj"


def test_the_table_shows_shares_with_wilson_intervals():
    rows = [
        {"speed": "low", "fps": 12.0, "policy": "greedy", "outcome": outcome}
        for outcome in ["success"] * 8 + ["collision"] * 2
    ]
    console = Console(record=True, width=100)
    print_table(rows, console)
    text = console.export_text()
    assert "80 [49–94]" in text  # Wilson's interval of 8 in 10, by hand: 0.490 to 0.943
    assert "20 [6–51]" in text
