from flowrep.experiment.cadence import Every


def test_every_fires_once_for_each_multiple_that_a_jump_passes():
    every = Every(100)
    assert [every(step) for step in (32, 64, 96, 128, 160, 192, 224)] == [
        False,
        False,
        False,
        True,
        False,
        False,
        True,
    ]


def test_every_zero_never_fires():
    assert not any(Every(0)(step) for step in range(5))


def test_every_continues_after_a_resume_without_firing_again():
    assert not Every(100, last=130)(150)
    assert Every(100, last=130)(201)
