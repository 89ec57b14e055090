"""Estimates and comparisons on outcomes whose bootstrap can be worked by hand."""

import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="reports are an extra")

from flowrep.report.statistics import Bootstrap, effect, holm, rates

NAN = np.nan
NOISE = "can't be told from noise"


def runs(*successes, episodes=10):
    """A row a run, the first of its episodes successes."""
    return np.array([[1.0] * n + [0.0] * (episodes - n) for n in successes])


def compared(*scenes):
    """A comparison over scenes, and its verdict."""
    found = Bootstrap(500).compare(scenes)
    return found, found.verdict(found.p_value)


def test_a_rate_counts_the_episodes_that_a_run_drove():
    outcomes = np.array([[1.0, 0.0, NAN, NAN], [1.0, 1.0, 1.0, 0.0]])
    assert rates(outcomes).tolist() == [0.5, 0.75]
    # the first episode twice, the second never; the run keeps its own where it drove none
    weights = np.array([[2.0, 0.0, 1.0, 1.0], [0.0, 0.0, 2.0, 2.0]])
    assert rates(outcomes, weights).tolist() == [[1.0, 0.75], [0.5, 0.5]]


def test_runs_are_resampled():
    # All or nothing, so that episodes say nothing: means of two draws of {0, 1} are 0, 1/2 and 1,
    # with 1/4, 1/2 and 1/4; Wilson's of 10 of 20 would be 0.30 to 0.70.
    assert Bootstrap(4000).success([runs(0, 10)]) == (0.5, 0.0, 1.0)


def test_episodes_are_resampled_the_same_ones_for_all_runs():
    # Equal runs: a bootstrap over seeds alone has no width. With episodes in common, that of n
    # runs is that of one: a binomial of 100 at 0.5, 0.5 ± 1.96 · 0.05. Were they drawn run by run,
    # it would be ± 1.96 · 0.05 / sqrt(4).
    found = Bootstrap(8000).success([runs(50, 50, 50, 50, episodes=100)])
    assert found[1:] == pytest.approx((0.402, 0.598), abs=0.011)


def test_scenes_are_strata_that_are_resampled_independently():
    # One scene always succeeds, the other never: resampled within scenes the mean stays 0.5 in
    # every draw, and the interval is that of 0 of 20; resampled from all runs it would be 0 to 1.
    found = Bootstrap(500).success([runs(10, 10), runs(0, 0)])
    assert found == pytest.approx((0.5, 0.339, 0.661), abs=0.001)
    # Two scenes of one run at 0.5 in 100 episodes: the variance of their mean is half of one's.
    found = Bootstrap(8000).success([runs(50, episodes=100), runs(50, episodes=100)])
    assert found.high - 0.5 == pytest.approx(1.96 * 0.05 / math.sqrt(2), abs=0.008)


@pytest.mark.parametrize(
    ("successes", "expected"),
    [
        # one run, 8 of 10: (0.8 + z²/20 ± z·sqrt(0.8·0.2/10 + z²/400)) / (1 + z²/10), z = 1.96
        ([8], (0.8, 0.490, 0.943)),
        # runs that end alike, 0 of 10 episodes that they share: upper bound z² / (10 + z²)
        ([0, 0], (0.0, 0.0, 0.278)),
        ([10, 10], (1.0, 0.722, 1.0)),
    ],
)
def test_one_run_and_runs_that_all_end_alike_have_wilsons_interval(successes, expected):
    assert Bootstrap().success([runs(*successes)]) == pytest.approx(expected, abs=0.001)


def test_more_runs_in_the_easier_scene_are_no_advantage():
    # 5 points better in both scenes, with two and four runs against four and two. Over all runs
    # it would be (2 · 0.9 + 4 · 0.15) / 6 = 0.4 against 0.6.
    easy = (runs(90, 90, episodes=100), runs(85, 85, 85, 85, episodes=100))
    hard = (runs(15, 15, 15, 15, episodes=100), runs(10, 10, episodes=100))
    found, verdict = compared(easy, hard)
    assert found.difference.value == pytest.approx(0.05)
    assert (found.p_value, verdict) == (0, "higher")
    assert found.verdict(0.06) == NOISE  # corrected for many comparisons


def test_a_pooled_share_counts_all_runs_failures_together():
    # 1 of 4 failures and 4 of 6: 5 of 10; the mean of the runs' shares would be 0.458
    outcomes = np.array([[1, 0, 0, 0, NAN, NAN], [1, 1, 1, 1, 0, 0]])
    assert Bootstrap(100).pooled_share(outcomes).value == 0.5
    assert Bootstrap(100).pooled_share(outcomes[:1]).value == 0.25  # one run: Wilson's
    assert math.isnan(Bootstrap(100).pooled_share(np.full((2, 3), NAN)).value)
    # All or nothing, of 1 and of 3 failures: pooled 1/4; draws are 0, 1/4 and 1, a quarter, a
    # half and a quarter of them.
    uneven = np.array([[1] * 10 + [NAN] * 20, [0] * 30], dtype=float)
    assert Bootstrap(4000).pooled_share(uneven) == (0.25, 0.0, 1.0)


def test_a_difference_on_the_same_episodes_is_free_of_what_they_have_in_common():
    # Equal outcomes episode by episode: paired, the difference is 0 in every draw, and its interval
    # Wilson's of 0 of 100; unpaired it would be ± 0.14.
    found, verdict = compared((runs(50, episodes=100), runs(50, episodes=100)))
    assert found.difference == pytest.approx((0.0, -0.037, 0.037), abs=0.001)
    assert found.improvement.value == 0.5  # a tie is half
    assert verdict == NOISE


def test_improvement_is_the_share_of_pairs_in_which_the_first_is_higher():
    # 3 beats 1 and 2; 2 beats 1 and ties with 2; of four pairs 3.5
    found, _ = compared((runs(3, 2), runs(1, 2)))
    assert found.improvement.value == 3.5 / 4
    assert compared((runs(1, 1, 1), runs(9, 9, 9)))[1] == "lower"


def test_few_seeds_say_it_of_these_agents_alone():
    one, verdict = compared((runs(90, episodes=100), runs(10, episodes=100)))
    assert math.isnan(one.p_value)
    assert verdict == "higher for these agents; one seed a side say no more"
    pair = (runs(90, 91, episodes=100), runs(10, 11, episodes=100))
    assert compared(pair)[1] == "higher for these agents; 2 seeds a side say no more"
    assert compared(pair, pair)[1] == "higher"  # of two scenes there are four runs a side


def test_a_bootstrap_that_is_too_sure_is_overruled():
    # Scores 0.1 and 0.9 against 0 and 0.05: every draw of runs has the first ahead or level, yet
    # two runs that differ by 0.8 among themselves tell nothing.
    found, verdict = compared((runs(10, 90, episodes=100), runs(0, 5, episodes=100)))
    assert found.difference.low > 0
    assert verdict == NOISE


def scores(*values):
    return np.array(values, dtype=float)


def test_an_effect_over_scenes_is_the_mean_of_their_differences_with_a_t_interval():
    # Differences 0.2 and 0.4; variances of the means 0.01/3 and 0.04/3 in the first scene, 0.02/2
    # and 0 in the second: error sqrt(0.05/3 + 0.01) / 2 = 0.0816, with
    # (0.02667)² / ((0.01/3)²/2 + (0.04/3)²/2 + 0.01²/1) = 3.66 degrees, t = 2.881
    found = effect(
        [(scores(0.5, 0.6, 0.7), scores(0.2, 0.4, 0.6)), (scores(0.8, 1.0), scores(0.5, 0.5))]
    )
    assert found.value == pytest.approx(0.3)
    assert found.error == pytest.approx(0.0816, abs=1e-4)
    assert found.freedom == pytest.approx(3.66, abs=0.01)
    assert found.interval().low == pytest.approx(0.3 - 2.881 * 0.0816, abs=1e-3)
    assert found.p_value == pytest.approx(0.024, abs=0.002)


def test_an_effect_of_one_side_is_its_mean_against_0():
    # 0.2, 0.3, 0.4: error 0.1 / sqrt(3), two degrees, t = 4.303
    found = effect([(scores(0.2, 0.3, 0.4),)])
    assert found.interval() == pytest.approx((0.3, 0.0517, 0.5483), abs=1e-3)
    assert math.isnan(effect([(scores(0.2), scores(0.1, 0.3))]).p_value)  # one run alone


def test_holm_leaves_out_what_is_not_known():
    assert holm([0.02, math.nan, 0.01])[::2] == [0.02, 0.02]
    assert math.isnan(holm([0.02, math.nan])[1])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([0.01, 0.04, 0.03]) == [0.03, 0.06, 0.06]  # in the order of the p values
