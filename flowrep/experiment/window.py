"""A window in which a policy drives, or a person by the arrow keys."""

import time
from collections.abc import Callable
from contextlib import suppress
from itertools import cycle
from typing import Any

import torch
from tensordict import TensorDictBase

from flowrep.experiment.evaluation import Policy, evaluate
from flowrep.experiment.film import Film, how_it_ended
from flowrep.scenes.vehicle import NO_OP, TURN_LEFT, TURN_RIGHT
from flowrep.usage import UsageError


class NewEpisode(Exception):
    """The person skips the rest of the episode."""


class Keyboard:
    """A policy that acts by the arrow keys that are held down, or hands over to another policy.

    Both arrow keys together cancel out.

    Args:
        other: the policy that drives after S is pressed.
        name: the name of that policy, for the window's title.
    """

    ACTIONS = {"left": TURN_LEFT, "right": TURN_RIGHT}  # noqa: RUF012 - never changed
    HELP = "← → steer    S switch driver    R new episode    Q quit"

    def __init__(self, other: Policy, name: str) -> None:
        self.is_over = self.is_new = False
        self._other, self._held = other, set[str]()
        self._names = cycle([name, "you"])
        self.driver = "you"

    def press(self, key: str | None) -> None:
        """Handles a key press; matplotlib gives None for keys that it has no name for."""
        key = (key or "").lower()
        if key in self.ACTIONS:
            self._held.add(key)
        elif key == "s":
            self.driver = next(self._names)
        self.is_new |= key == "r"
        self.is_over |= key in ("q", "escape")

    def release(self, key: str | None) -> None:
        """Handles a key release."""
        self._held.discard((key or "").lower())

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes `action`."""
        if self.driver != "you":
            return self._other(tensordict)
        actions = [self.ACTIONS[key] for key in self._held]
        action = actions[0] if len(actions) == 1 else NO_OP
        return tensordict.set("action", torch.full(tensordict.shape, action))


def drive_by_hand(
    keyboard: Keyboard,
    film: Film,
    options: dict[str, Any],
    pause: Callable[[float], Any] | None = None,
) -> None:
    """Opens a window and drives one episode after the other until it is closed.

    The last frame of an episode stays in view until R begins the next one, with the next seed.
    `pause` draws and handles keys for some seconds; by default, it is Matplotlib's.
    """
    import matplotlib.pyplot as plt  # looks for a screen, which other views don't need

    # Disable Matplotlib's own shortcuts for the driver's keys (left: back, r: home, q: quit).
    shortcuts: Any = {name: [] for name in plt.rcParams if name.startswith("keymap.")}
    with plt.rc_context(shortcuts):
        figure = plt.figure(figsize=(12.5, 2.7))
        if pause is None and type(figure.canvas).required_interactive_framework is None:
            plt.close(figure)
            raise UsageError(
                "interactive=true needs a screen, and tkinter or PyQt to open a window on it "
                f"(matplotlib found only the backend {plt.get_backend()!r})"
            )
        listen = figure.canvas.mpl_connect
        listen("key_press_event", lambda event: keyboard.press(event.key))
        listen("key_release_event", lambda event: keyboard.release(event.key))
        listen("close_event", lambda event: keyboard.press("q"))
        while not keyboard.is_over:
            keyboard.is_new = False
            with suppress(NewEpisode):
                drive_in_window(figure, keyboard, film, options, pause or plt.pause)
            options = options | {"episode_seed": options["episode_seed"] + 1}
        plt.close(figure)


def drive_in_window(
    figure: Any,
    keyboard: Keyboard,
    film: Film,
    options: dict[str, Any],
    pause: Callable[[float], Any],
) -> None:
    """Drives an episode, draws each step at the env's frame rate, and waits for R or Q."""
    figure.clear()
    axes = figure.add_axes((0, 0, 1, 0.92))
    axes.set_axis_off()
    title = figure.suptitle("", fontfamily="monospace", fontsize=10)
    image: Any = None
    frame: Any = None
    drawn_at = time.monotonic()

    def show(picture: Any) -> None:
        nonlocal image
        image = image or axes.imshow(picture, interpolation="nearest")
        image.set_data(picture)

    def draw(tensordict: TensorDictBase) -> None:
        nonlocal frame, drawn_at
        if keyboard.is_over or keyboard.is_new:
            raise NewEpisode
        frame = film.frame(tensordict)
        show(film.draw(frame))
        title.set_text(f"{keyboard.driver} drives    {keyboard.HELP}")
        pause(max(1e-3, 1 / film.street.frame_rate_hz - (time.monotonic() - drawn_at)))
        drawn_at = time.monotonic()

    (episode,) = evaluate(film.env, keyboard, [options], on_frame=draw)
    show(film.draw(frame, episode))
    title.set_text(f"{how_it_ended(episode)}    {keyboard.HELP}")
    while not (keyboard.is_over or keyboard.is_new):
        pause(0.05)
