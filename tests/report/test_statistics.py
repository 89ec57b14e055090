"""Estimates and comparisons of a few runs, worked by hand."""

import math

import numpy as np
import pytest

from flowrep.report.statistics import Effect, effect, holm, improvement, mean_share


def rates(*values):
    return np.array(values, dtype=float)


def test_a_mean_over_runs_has_a_t_interval():
    # 0.2, 0.3, 0.4: standard error 0.1 / sqrt(3), two degrees, t = 4.303: ± 0.248. A normal
    # distribution would say ± 0.113.
    found = mean_share([rates(0.2, 0.3, 0.4)], episodes=100)
    assert found == pytest.approx((0.3, 0.0516, 0.5484), abs=1e-3)


def test_an_interval_of_shares_ends_at_0_and_1():
    assert mean_share([rates(0.0, 0.9)]) == (0.45, 0.0, 1.0)


def test_more_runs_in_the_easier_scene_are_no_advantage():
    # Over all runs it would be (4 · 0.9 + 2 · 0.1) / 6 = 0.63.
    found = mean_share([rates(0.9, 0.9, 0.9, 0.9), rates(0.1, 0.1)])
    assert found.value == pytest.approx(0.5)


def test_one_run_and_runs_that_all_end_alike_have_wilsons_interval():
    # one run, 8 of 10: (0.8 + z²/20 ± z·sqrt(0.8·0.2/10 + z²/400)) / (1 + z²/10), z = 1.96
    assert mean_share([rates(0.8)], 10) == pytest.approx((0.8, 0.490, 0.943), abs=0.001)
    # runs that end alike, 0 of 10 episodes: upper bound z² / (10 + z²)
    assert mean_share([rates(0, 0)], 10) == pytest.approx((0.0, 0.0, 0.278), abs=0.001)
    assert mean_share([rates(1, 1)], 10) == pytest.approx((1.0, 0.722, 1.0), abs=0.001)


def test_without_a_spread_or_episodes_no_interval_is_known():
    found = mean_share([rates(0.8), rates(0.4)])
    assert found.value == pytest.approx(0.6)
    assert math.isnan(found.low)
    assert math.isnan(found.high)


def test_an_effect_over_scenes_is_the_mean_of_their_differences_with_a_t_interval():
    # Differences 0.2 and 0.4; variances of the means 0.01/3 and 0.04/3 in the first scene, 0.02/2
    # and 0 in the second: error sqrt(0.05/3 + 0.01) / 2 = 0.0816, with
    # (0.02667)² / ((0.01/3)²/2 + (0.04/3)²/2 + 0.01²/1) = 3.66 degrees, t = 2.881
    found = effect([(rates(0.5, 0.6, 0.7), rates(0.2, 0.4, 0.6)), (rates(0.8, 1), rates(0.5, 0.5))])
    assert found.value == pytest.approx(0.3)
    assert found.error == pytest.approx(0.0816, abs=1e-4)
    assert found.freedom == pytest.approx(3.66, abs=0.01)
    assert found.interval().low == pytest.approx(0.3 - 2.881 * 0.0816, abs=1e-3)
    assert found.p_value == pytest.approx(0.024, abs=0.002)


def test_the_verdict_is_the_sign_of_a_difference_whose_corrected_p_is_small():
    higher, lower = Effect(0.2, 0.01, 4.0), Effect(-0.2, 0.01, 4.0)
    assert (higher.verdict(0.049), lower.verdict(0.049)) == ("higher", "lower")
    assert higher.verdict(0.051) == "not seen"
    assert higher.verdict(math.nan) == "can't be tested"


def test_without_a_spread_between_runs_there_is_no_test():
    alone = effect([(rates(0.9), rates(0.1, 0.2))])
    alike = effect([(rates(0.9, 0.9), rates(0.1, 0.1))])
    assert math.isnan(alone.p_value)
    assert math.isnan(alike.p_value)  # as p = 0 it would be the surest difference of all
    assert math.isnan(alike.interval().low)
    assert effect([(rates(0.5, 0.5), rates(0.5, 0.5))]).p_value == 1


def test_improvement_is_the_share_of_pairs_in_which_the_first_is_higher():
    # 3 beats 1 and 2; 2 beats 1 and ties with 2; of four pairs 3.5
    assert improvement([(rates(3, 2), rates(1, 2))]) == 3.5 / 4
    # the mean over scenes, however many pairs each has
    assert improvement([(rates(3, 2), rates(1, 2)), (rates(0), rates(1))]) == 3.5 / 8


def test_holm_leaves_out_what_is_not_known():
    assert holm([0.02, math.nan, 0.01])[::2] == [0.02, 0.02]
    assert math.isnan(holm([0.02, math.nan])[1])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([0.01, 0.04, 0.03]) == [0.03, 0.06, 0.06]  # in the order of the p values
