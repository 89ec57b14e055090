"""Driving by hand: keys to actions, and a window that is driven without a screen."""

import matplotlib
import matplotlib.pyplot as plt
import pytest
from matplotlib.backend_bases import KeyEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

pytest.importorskip("pybullet", reason="the cockpit drives the simulated street")

from flowrep.cockpit import Cockpit, NoScreenError, drive_by_hand, run_window
from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS

NO_OP, LEFT, RIGHT = 0, 1, 2


@pytest.fixture
def cockpit():
    env = StreetEnv("straight_road", sensors=SENSORS)
    yield Cockpit(env, seed=1)
    env.close()


def test_a_key_acts_while_it_is_held(cockpit):
    assert cockpit.action == NO_OP
    cockpit.press("left")
    assert cockpit.action == LEFT
    cockpit.press("right")  # both at once cancel
    assert cockpit.action == NO_OP
    cockpit.release("left")
    assert cockpit.action == RIGHT
    cockpit.release("right")
    cockpit.release(None)
    assert cockpit.action == NO_OP


def test_left_turns_left(cockpit):
    cockpit.press("left")
    for _ in range(5):
        cockpit.step()
    assert cockpit.env.episode.now.vehicle.yaw_rad > 0


def test_an_ended_episode_waits_for_r(cockpit):
    cockpit.press("left")
    for _ in range(40):
        cockpit.step()
    assert cockpit.title.startswith("out of bounds")
    assert "return -4." in cockpit.title
    seed = cockpit.env.episode.seed
    cockpit.press("r")
    assert cockpit.title.startswith("running   step 0")
    assert cockpit.env.episode.seed != seed


def test_without_a_screen_one_line_says_what_is_missing(cockpit):
    with matplotlib.rc_context({"backend": "agg"}), pytest.raises(NoScreenError) as caught:
        drive_by_hand(cockpit)
    assert "needs a screen" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_window_hears_the_keys_and_drives_at_each_tick(cockpit):
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    timer = run_window(figure, cockpit)
    before = figure.axes[0].images[0].get_array().copy()
    canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, "right"))
    ((tick, *_),) = timer.callbacks
    for _ in range(4):
        tick()
    assert timer.interval == round(1000 / 12)
    assert cockpit.env.episode.steps == 4
    assert cockpit.env.episode.now.vehicle.yaw_rad < 0
    assert (figure.axes[0].images[0].get_array() != before).any()
    canvas.callbacks.process("key_release_event", KeyEvent("key_release_event", canvas, "right"))
    assert cockpit.action == NO_OP


def test_q_closes_the_window_and_leaves_pyplot_nothing_to_wait_for(cockpit):
    with matplotlib.rc_context({"backend": "agg", "keymap.quit": []}):
        figure = plt.figure()
        timer = run_window(figure, cockpit)
        ((tick, *_),) = timer.callbacks
        tick()
        event = KeyEvent("key_press_event", figure.canvas, "q")
        figure.canvas.callbacks.process("key_press_event", event)
        assert plt.fignum_exists(figure.number)
        tick()
        assert not plt.fignum_exists(figure.number)
    assert cockpit.env.episode.steps == 1  # none after Q
