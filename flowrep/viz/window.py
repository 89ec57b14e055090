"""A window in which a person drives a street with the arrow keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from flowrep.envs.street_env import StreetEnv
from flowrep.scenes.scene import NO_OP, TURN_LEFT, TURN_RIGHT
from flowrep.viz.film import maps_of
from flowrep.viz.maps import Image, representation_strip

ACTION_OF_KEY = {"left": TURN_LEFT, "right": TURN_RIGHT}
HELP = "← → steer    R new episode    Q quit"


class NoScreenError(RuntimeError):
    """A window can't be opened."""


class KeyboardDriver:
    """Turns key presses into actions and returns the pictures to show, independent of any window.

    A key acts while it is held; both together cancel out. A finished episode stays visible until R
    begins the next.
    """

    def __init__(self, env: StreetEnv, *, seed: int | None = None, path: str | None = None) -> None:
        """Begins the first episode."""
        self.env = env
        self.is_over = False  # Q was pressed
        self._held: set[str] = set()
        self._options = None if path is None else {"path": path}
        self._K = torch.as_tensor(env.K)
        self._begin(seed)

    def press(self, key: str | None) -> None:
        """Handles a key press."""
        if key in ACTION_OF_KEY:
            self._held.add(key)
        elif key in ("r", "R"):
            self._begin(None)
        elif key in ("q", "Q", "escape"):
            self.is_over = True

    def release(self, key: str | None) -> None:
        """Handles a key release."""
        self._held.discard(key or "")

    @property
    def action(self) -> int:
        """The action for the held keys."""
        actions = [ACTION_OF_KEY[key] for key in self._held]
        return actions[0] if len(actions) == 1 else NO_OP

    def step(self) -> None:
        """Drives one step, unless the episode has ended."""
        if not self.env.episode.outcome:
            self._observation, reward, _, _, self._info = self.env.step(self.action)
            self._return += reward

    @property
    def title(self) -> str:
        """The window's title: the state of the episode."""
        episode = self.env.episode
        hit = f" ({self._info['hit']})" if self._info["hit"] else ""
        state = f"{episode.outcome.label.replace('_', ' ')}{hit}"
        return f"{state}   step {episode.steps}   return {self._return:.2f}   {HELP}"

    def picture(self) -> Image:
        """Returns the camera's picture and its representations, side by side."""
        sensor: Mapping[str, Any] = {
            name: torch.as_tensor(value) for name, value in self._observation.items()
        }
        return representation_strip(maps_of(sensor, self._K))

    def _begin(self, seed: int | None) -> None:
        self._observation, self._info = self.env.reset(seed=seed, options=self._options)
        self._return = 0.0


def drive_by_hand(driver: KeyboardDriver, show: Callable[[], None] | None = None) -> None:
    """Opens a window and drives at the scene's frame rate until it is closed.

    Args:
        driver: handles the keys.
        show: blocks while the window is open; matplotlib's own by default.

    Raises:
        NoScreenError: there is no screen, or no GUI toolkit.
    """
    import matplotlib.pyplot as plt

    # Disable Matplotlib's own shortcuts for the driver's keys (left: back, r: home, q: quit).
    shortcuts: Any = {name: [] for name in plt.rcParams if name.startswith("keymap.")}
    with plt.rc_context(shortcuts):
        figure = plt.figure(figsize=(15, 3.2))
        if type(figure.canvas).required_interactive_framework is None:
            plt.close(figure)
            raise NoScreenError(
                "interactive=true needs a screen, and tkinter or PyQt to open a window on it "
                f"(matplotlib found only the backend {plt.get_backend()!r})"
            )
        run_window(figure, driver)
        (show or plt.show)()
        plt.close(figure)


def run_window(figure: Any, driver: KeyboardDriver) -> Any:
    """Connects a matplotlib figure to a driver; returns the timer that steps it."""
    import matplotlib.pyplot as plt

    axes = figure.add_axes((0, 0, 1, 0.92))
    axes.set_axis_off()
    image = axes.imshow(driver.picture(), interpolation="nearest")
    title = figure.suptitle(driver.title, fontfamily="monospace", fontsize=10)
    timer = figure.canvas.new_timer(interval=round(1000 / driver.env.frame_rate_hz))

    def tick() -> None:
        if driver.is_over:
            timer.stop()
            # Not the manager's own destroy: pyplot would keep waiting for the closed window.
            plt.close(figure)
            return
        driver.step()
        image.set_data(driver.picture())
        title.set_text(driver.title)
        figure.canvas.draw_idle()

    figure.canvas.mpl_connect("key_press_event", lambda event: driver.press(event.key))
    figure.canvas.mpl_connect("key_release_event", lambda event: driver.release(event.key))
    timer.add_callback(tick)
    timer.start()
    return timer
