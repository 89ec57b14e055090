from flowrep.experiment.evaluation import outcome_shares, wilson_interval


def test_no_episodes_say_nothing():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_an_interval_contains_its_share_and_stays_a_probability():
    for successes in range(11):
        low, high = wilson_interval(successes, 10)
        assert 0.0 <= low <= successes / 10 <= high <= 1.0


def test_shares_are_of_all_episodes():
    shares = outcome_shares(["success", "success", "timeout", "collision"])
    assert [round(share, 2) for share, _, _ in shares.values()] == [0.5, 0.25, 0.0, 0.25]


def test_the_share_is_within_its_interval_also_when_all_or_none_succeed():
    for trials in range(1, 400):  # at 192 of 192, for example, the end is rounded to less than 1
        assert wilson_interval(trials, trials)[1] == 1.0
        assert wilson_interval(0, trials)[0] == 0.0
