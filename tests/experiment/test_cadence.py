from flowrep.experiment.cadence import Every, UpdatesDue


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


def test_updates_due_owes_one_update_for_ten_frames_from_the_first_full_batch_on():
    due = UpdatesDue(frames_per_update=10, learning_starts=256)
    counts = [due(frames) for frames in range(32, 32 * 21, 32)]
    assert sum(counts[:8]) == 0  # 256 frames: the buffer has just filled one batch
    assert sum(counts) == (640 - 256) // 10


def test_updates_due_resumed_owes_what_the_uninterrupted_run_does():
    whole = UpdatesDue(10, 100)
    counts = [whole(frames) for frames in range(32, 640, 32)]
    resumed = UpdatesDue(10, 100, done=sum(counts[:10]))
    assert [resumed(frames) for frames in range(32 * 11, 640, 32)] == counts[10:]
