"""How episodes ended, in numbers: shares with intervals, causes of failure, tables."""

import math

import pytest

from flowrep.experiment.outcomes import (
    CAUSES,
    COLUMNS,
    OUTCOMES,
    failure_causes,
    outcome_shares,
    print_results,
    print_table,
    success_of,
    wilson_interval,
)
from flowrep.experiment.run import RunFolder
from tests.experiment.test_run import episode


def test_outcomes_are_those_of_the_simulator_in_the_order_of_their_codes():
    from flowrep.envs import Outcome

    assert [Outcome(code).label for code in (1, 2, 3, 4)] == [*OUTCOMES]


def test_a_record_has_a_cell_for_each_column_of_the_table():
    """The columns of docs/runs.md, in their order."""
    row = episode(7, "timeout", return_=-4.30001, path="left").row()
    assert [*row] == [*COLUMNS] == [
        "scene", "scene_id", "representations", "flow", "seed", "frames", "evaluation", "policy",
        "speed", "fps", "episode_seed", "path", "outcome", "hit", "return", "length",
    ]  # fmt: skip
    assert (row["episode_seed"], row["path"], row["outcome"]) == (7, "left", "timeout")
    assert row["return"] == -4.3


def test_an_interval_contains_its_share_and_stays_a_probability():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    for successes in range(11):
        low, high = wilson_interval(successes, 10)
        assert 0.0 <= low <= successes / 10 <= high <= 1.0
    for trials in range(1, 400):  # at 192 of 192, for example, the end is rounded to less than 1
        assert wilson_interval(trials, trials)[1] == 1.0
        assert wilson_interval(0, trials)[0] == 0.0


def test_shares_are_of_all_episodes():
    shares = outcome_shares(["success", "success", "timeout", "collision"])
    assert [round(share, 2) for share, _, _ in shares.values()] == [0.5, 0.25, 0.0, 0.25]


def test_a_runs_success_is_that_of_greedy_actions_or_of_sampled_ones_alone(tmp_path):
    """Baselines and earlier evaluations of a run that was made longer don't count."""
    run = RunFolder(tmp_path)
    assert math.isnan(success_of(run.path))

    def save(policy, frames, *outcomes):
        same = {"policy": policy, "frames": frames, "evaluation": "final"}
        run.save_episodes([episode(i, end, **same) for i, end in enumerate(outcomes)])

    save("planner", 9, "success")
    save("sampled", 9, "success", "timeout", "timeout", "timeout")
    assert success_of(run.path) == 0.25
    save("greedy", 5, "success")
    save("greedy", 9, "success", "timeout")
    assert success_of(run.path) == 0.5


ENDS = [("success", "")] * 2 + [("collision", "pedestrian")] * 3 + [("collision", "car")]
ENDS += [("out_of_bounds", "")] * 2 + [("timeout", "")] * 2


def failed_rows(policy="greedy", ends=ENDS):
    same = {"scene": "s_turn", "representations": "ego+obj", "speed": "low", "fps": 12.0}
    return [same | {"policy": policy, "outcome": outcome, "hit": hit} for outcome, hit in ends]


def test_failures_are_counted_by_cause():
    # 2 off the road, 3 into people, 1 into a car, 2 too slow
    assert [failure_causes(failed_rows())[cause] for cause in CAUSES] == [2, 3, 1, 2]
    assert failure_causes(failed_rows(ends=ENDS[:2])).total() == 0


def test_tables_show_shares_with_intervals_and_causes_and_nothing_is_cut_off(capsys):
    print_results(failed_rows("never_turn") + failed_rows("sampled", ENDS[:2] * 4))
    text = capsys.readouterr().out
    assert "…" not in text
    assert "20 [6–51]" in text  # Wilson's interval of 2 in 10, by hand: 0.057 to 0.510
    for word in ("never_turn", "bounds", "pedestrian", "timeout", "8 of 10", "38", "0 of 8"):
        assert word in text


@pytest.mark.parametrize("name", ["a[/b]c", "x[red]y", "[link=x]z", "a:car:b"])
def test_the_names_of_policies_and_tables_are_printed_as_they_are(capsys, name):
    print_results(failed_rows(name))
    print_table(f"of {name}", [{"policy": "as wide as its title"}])
    assert capsys.readouterr().out.count(name) == 3
