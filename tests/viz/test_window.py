"""Driving by hand: keys to actions, and a window that is driven without a screen."""

import matplotlib
import matplotlib.pyplot as plt
import pytest
from matplotlib.backend_bases import KeyEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

pytest.importorskip("pybullet", reason="the driver drives the simulated street")

from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS
from flowrep.viz.window import KeyboardDriver, NoScreenError, drive_by_hand, run_window

NO_OP, LEFT, RIGHT = 0, 1, 2


@pytest.fixture
def driver():
    env = StreetEnv("straight_road", sensors=SENSORS)
    yield KeyboardDriver(env, seed=1)
    env.close()


def test_a_key_acts_while_it_is_held(driver):
    assert driver.action == NO_OP
    driver.press("left")
    assert driver.action == LEFT
    driver.press("right")  # both at once cancel
    assert driver.action == NO_OP
    driver.release("left")
    assert driver.action == RIGHT
    driver.release("right")
    driver.release(None)
    assert driver.action == NO_OP


def test_left_turns_left(driver):
    driver.press("left")
    for _ in range(5):
        driver.step()
    assert driver.env.episode.now.vehicle.yaw_rad > 0


def test_an_ended_episode_waits_for_r(driver):
    driver.press("left")
    for _ in range(40):
        driver.step()
    assert driver.title.startswith("out of bounds")
    assert "return -4." in driver.title
    seed = driver.env.episode.seed
    driver.press("r")
    assert driver.title.startswith("running   step 0")
    assert driver.env.episode.seed != seed


def test_without_a_screen_one_line_says_what_is_missing(driver):
    with matplotlib.rc_context({"backend": "agg"}), pytest.raises(NoScreenError) as caught:
        drive_by_hand(driver)
    assert "needs a screen" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_window_hears_the_keys_and_drives_at_each_tick(driver):
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    timer = run_window(figure, driver)
    before = figure.axes[0].images[0].get_array().copy()
    canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, "right"))
    ((tick, *_),) = timer.callbacks
    for _ in range(4):
        tick()
    assert timer.interval == round(1000 / 12)
    assert driver.env.episode.steps == 4
    assert driver.env.episode.now.vehicle.yaw_rad < 0
    assert (figure.axes[0].images[0].get_array() != before).any()
    canvas.callbacks.process("key_release_event", KeyEvent("key_release_event", canvas, "right"))
    assert driver.action == NO_OP


def test_q_closes_the_window_and_leaves_pyplot_nothing_to_wait_for(driver):
    with matplotlib.rc_context({"backend": "agg", "keymap.quit": []}):
        figure = plt.figure()
        timer = run_window(figure, driver)
        ((tick, *_),) = timer.callbacks
        tick()
        event = KeyEvent("key_press_event", figure.canvas, "q")
        figure.canvas.callbacks.process("key_press_event", event)
        assert plt.fignum_exists(figure.number)
        tick()
        assert not plt.fignum_exists(figure.number)
    assert driver.env.episode.steps == 1  # none after Q
