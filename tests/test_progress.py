import os
import signal

import pytest

from flowrep.progress import Every, StopRequest


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["ctrl-c", "sigterm"]
)
def test_a_signal_asks_and_the_shell_gets_its_exit_code(number, code):
    with StopRequest() as stop:
        assert not stop
        os.kill(os.getpid(), number)
        assert stop
        assert stop.exit_code == code


@pytest.fixture
def ctrl_c_raises():
    """Python's own handler: a process started in the background may have SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("first", [[signal.SIGINT], [signal.SIGTERM, signal.SIGTERM]])
def test_a_ctrl_c_after_a_signal_ends_at_once_and_another_sigterm_does_not(ctrl_c_raises, first):
    with StopRequest() as stop:
        for number in first:
            os.kill(os.getpid(), number)
        assert stop.exit_code == 128 + first[0]
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_the_previous_handlers_come_back():
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before


def test_every_fires_once_for_each_multiple_that_a_jump_passes():
    every = Every(100)
    assert [step for step in range(0, 257, 32) if every(step)] == [128, 224]
    assert not any(map(Every(0), range(5)))


def test_every_continues_after_a_resume_without_firing_again():
    assert not Every(100, last=130)(150)
    assert Every(100, last=130)(201)
