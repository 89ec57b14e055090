"""Why episodes fail, worked out from rows of evaluation.csv."""

import csv

import pytest
from rich.console import Console

from flowrep.experiment.failures import failure_causes, print_failures, write_failures

ENDS = [
    ("success", ""),
    ("success", ""),
    ("collision", "pedestrian"),
    ("collision", "pedestrian"),
    ("collision", "car"),
    ("collision", "pedestrian"),
    ("out_of_bounds", ""),
    ("out_of_bounds", ""),
    ("timeout", ""),
    ("timeout", ""),
]


def rows(policy="greedy", ends=ENDS):
    same = {"scene": "s_turn", "representations": "ego+obj", "speed": "low", "fps": 12.0}
    return [same | {"policy": policy, "outcome": outcome, "hit": hit} for outcome, hit in ends]


def test_shares_are_of_the_failures():
    (line,) = failure_causes(rows())
    assert (line["episodes"], line["failures"]) == (10, 8)
    # Of 8: 2 off the road, 3 into people, 1 into a car, 2 too slow.
    assert line["out of bounds"] == 25.0
    assert line["collision: pedestrian"] == 37.5
    assert line["collision: other"] == 12.5
    assert line["timeout"] == 25.0
    assert line["out of bounds to collisions"] == 0.5


def test_policies_are_told_apart_and_no_failure_has_no_shares():
    greedy, planner = failure_causes(rows() + rows("planner", [("success", "")] * 3))
    assert (greedy["policy"], planner["policy"]) == ("greedy", "planner")
    assert (planner["failures"], planner["timeout"]) == (0, "")


def test_an_agent_is_not_mixed_with_what_it_was_earlier_in_training():
    early = [row | {"frames": 1000} for row in rows(ends=[("out_of_bounds", "")] * 4)]
    late = [row | {"frames": 9000} for row in rows(ends=[("collision", "pedestrian")] * 2)]
    first, last = failure_causes(early + late)
    assert (first["frames"], first["failures"], first["out of bounds"]) == ("1000", 4, 100.0)
    assert (last["frames"], last["failures"], last["out of bounds"]) == ("9000", 2, 0.0)


def test_the_table_is_printed_and_replaced(tmp_path):
    console = Console(record=True, width=120)
    print_failures(rows(), console)
    text = console.export_text()
    assert "8 of 10" in text
    assert "pedestrian" in text
    path = tmp_path / "failures.csv"
    write_failures(path, rows() + rows("random"))
    write_failures(path, rows())
    with path.open(newline="") as file:
        (line,) = csv.DictReader(file)
    assert line["collision: pedestrian"] == "37.5"
    assert float(line["timeout"]) == pytest.approx(25.0)


def test_nothing_of_the_table_is_cut_off_where_little_fits():
    console = Console(record=True, width=100)
    print_failures(rows("never_turn") + rows("sampled"), console)
    text = console.export_text()
    assert "…" not in text
    for word in ("never_turn", "bounds", "pedestrian", "timeout", "8 of 10"):
        assert word in text
