"""Shows a scene and how a policy drives in it: `python -m flowrep.view scene=s_turn`."""

import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

from flowrep.extras import require

require("viewing", "train", "hydra", "pydantic", module=__name__)

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from flowrep.baselines import BaselinePolicy
from flowrep.config import UsageError
from flowrep.config.cli import run_command
from flowrep.config.schema import ViewConfig
from flowrep.envs import street_envs
from flowrep.experiment.agents import Agent
from flowrep.experiment.evaluation import Episode, Policy, evaluate, print_table
from flowrep.experiment.film import Maps, draw_frames, film_episode, make_filmed, maps_of
from flowrep.palette import CATEGORY_ID
from flowrep.policies import load_agent
from flowrep.scenes import Scene
from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import NO_OP, TURN_LEFT, TURN_RIGHT
from flowrep.tables import write_rows
from flowrep.viz import contact_sheet, write_png, write_video
from flowrep.viz.plan import Track, draw_plan

ENVS = 16  # side by side, for the episodes that are not filmed


def run(config: ViewConfig) -> None:
    """Writes pictures, a video and tables of the scene, or opens a window on it."""
    job = HydraConfig.get()
    is_scene_given = any(text.startswith("scene") for text in job.overrides.task)
    agent = agent_of(config, is_scene_given)
    env = make_filmed(make_env_of(config, agent), agent.config.representations)
    options = episodes_of(config, env.base_env.scene)
    if config.interactive:
        policy = agent.policy
        other = BaselinePolicy(policy, env) if isinstance(policy, str) else policy
        drive_by_hand(Keyboard(other, Path(config.policy).name), env, options[0])
    else:
        view(config, agent, env, options, Path(job.runtime.output_dir))
    env.close()


def agent_of(config: ViewConfig, is_scene_given: bool) -> Agent:
    """Returns what drives; a run's agent drives in its own scene unless one was given."""
    is_at_home = Path(config.policy).is_dir() and not is_scene_given
    scene, maps = None if is_at_home else config.scene, config.representations
    here: dict[str, Any] = {"device": "cpu", "num_envs": 1, "num_workers": 0}
    here["algorithm"] = config.algorithm.target
    return load_agent(config.policy, scene=scene, representations=maps, **here)


def make_env_of(config: ViewConfig, agent: Agent) -> Callable[..., EnvBase]:
    """Returns what makes the agent's envs, at the speed and frame rate of the config."""
    return partial(agent.make_env, speed=config.speed, frame_rate_hz=config.frame_rate_hz)


def episodes_of(config: ViewConfig, scene: Scene) -> list[dict[str, Any]]:
    """Returns the options of the episodes to view."""
    paths = [path.name for path in scene.paths]
    if config.path not in (*paths, None):
        raise UsageError(f"path should be {', '.join(paths)} or null, not '{config.path}'")
    path = {} if config.path is None else {"path": config.path}
    seeds = range(config.seed, config.seed + config.episodes)
    return [{"episode_seed": seed, "speed": config.speed} | path for seed in seeds]


def view(
    config: ViewConfig, agent: Agent, env: EnvBase, options: list[dict[str, Any]], folder: Path
) -> None:
    """Drives episodes and writes their pictures, plan, video and tables into a folder."""
    scene, fps = env.base_env.scene, env.base_env.frame_rate_hz
    with tqdm(desc="driving", unit="frame") as bar:
        frames, episode = film_episode(env, agent.policy, options[0], lambda _: bar.update())
    episodes = [episode, *drive_on(config, agent, options[1:])]
    strips = list(draw_frames(tqdm(frames, desc="drawing", unit="frame"), env))
    chosen = moments([moving_pixels(maps) for maps in frames], config.sheet_rows)
    folder.mkdir(parents=True, exist_ok=True)
    write_png(folder / "sheet.png", contact_sheet(strips[i] for i in chosen))
    if config.video:
        write_video(folder / "episode.mp4", strips, fps=fps)
    tracks = [Track(each.positions.astype(float), each.outcome) for each in episodes]
    # Closed exits belong to a path; they are drawn if all episodes took the same one.
    path = episode.path if all(each.path == episode.path for each in episodes) else None
    draw_plan(Layout(scene), tracks, path=path).savefig(folder / "plan.png", dpi=110)
    tables = {
        "episodes": [{"path": each.path, **each.row()} for each in episodes],
        "categories": category_rows(scene.categories, (maps["semantic"] for maps in frames)),
    }
    for name, rows in tables.items():
        write_rows(folder / f"{name}.csv", rows)
        print_table(name, rows)
    arrived = sum(each.outcome == "success" for each in episodes)
    print(f"{config.policy}: {arrived} of {len(episodes)} episodes end in success")
    written = ["sheet.png", *["episode.mp4"] * config.video, "plan.png"]
    print(f"{folder}: {', '.join([*written, 'episodes.csv', 'categories.csv'])}")


def drive_on(config: ViewConfig, agent: Agent, options: list[dict[str, Any]]) -> list[Episode]:
    """Returns the episodes after the first, in their order, with what the policy sees alone."""
    if not options:
        return []
    env = make_env_of(config, agent)(num_envs=min(ENVS, len(options)))
    found = evaluate(env, agent.policy, options)
    episodes = list(tqdm(found, desc="driving on", unit="episode", total=len(options)))
    env.close()
    return sorted(episodes, key=lambda episode: episode.seed)


def category_rows(categories: Iterable[str], semantic: Iterable[Any]) -> list[dict[str, Any]]:
    """Returns each category's share of the pixels of semantic maps and of the maps, in %."""
    counts = np.stack([np.bincount(np.ravel(ids), minlength=256) for ids in semantic])
    pixels, pictures = counts.sum(axis=0), (counts > 0).mean(axis=0)
    return [
        {
            "category": name,
            "pixels": int(pixels[CATEGORY_ID[name]]),
            "pixels_percent": round(100 * pixels[CATEGORY_ID[name]] / pixels.sum(), 3),
            "pictures_percent": round(100 * pictures[CATEGORY_ID[name]], 1),
        }
        for name in categories
    ]


def moving_pixels(maps: Maps) -> int:
    """Returns the number of pixels that move by themselves and are not close to the camera."""
    return int(((maps["obj"] != 0).any(0) & (maps["depth"][0] > 4.0)).sum())


def moments(motion: list[int], count: int) -> list[int]:
    """Returns frame indices for a contact sheet: the one with most motion in each of `count` parts.

    >>> moments([0, 0, 3, 1, 0, 0, 0, 2], 2)
    [2, 7]
    """
    ends = [round(i * len(motion) / count) for i in range(count + 1)]
    return [max(range(a, b), key=lambda i: motion[i]) for a, b in pairwise(ends) if b > a]


class NewEpisode(Exception):
    """The episode was left for the next one."""


class Keyboard:
    """A policy that takes the action of the held keys, or lets another, of this name, drive.

    Both keys together cancel out.
    """

    ACTIONS = {"left": TURN_LEFT, "right": TURN_RIGHT}  # noqa: RUF012 - never changed
    HELP = "← → steer    S switch driver    R new episode    Q quit"

    def __init__(self, other: Policy, name: str) -> None:
        self.is_over = self.is_new = False
        self._other, self._held = other, set[str]()
        self._names = cycle([name, "you"])
        self.driver = "you"

    def press(self, key: str | None) -> None:
        """Handles a key press; other keys than letters may have no name."""
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
    env: EnvBase,
    options: dict[str, Any],
    pause: Callable[[float], Any] | None = None,
) -> None:
    """Opens a window and drives one episode after the other until it is closed.

    A finished one stays in view until R begins the next, of the next seed. `pause` draws, and
    handles keys for some seconds; by default in a window on the screen.
    """
    import matplotlib.pyplot as plt

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
                drive_in_window(figure, keyboard, env, options, pause or plt.pause)
            options = options | {"episode_seed": options["episode_seed"] + 1}
        plt.close(figure)


def drive_in_window(
    figure: Any,
    keyboard: Keyboard,
    env: EnvBase,
    options: dict[str, Any],
    pause: Callable[[float], Any],
) -> None:
    """Drives an episode, draws each step at the env's frame rate, and waits for R or Q."""
    figure.clear()
    axes = figure.add_axes((0, 0, 1, 0.92))
    axes.set_axis_off()
    title = figure.suptitle("", fontfamily="monospace", fontsize=10)
    intrinsics = torch.from_numpy(street_envs(env)[0].K)
    image, drawn_at = None, time.monotonic()

    seen: deque[Maps] = deque()
    pictures = draw_frames(iter(seen.popleft, None), env)

    def draw(tensordict: TensorDictBase) -> None:
        nonlocal image, drawn_at
        if keyboard.is_over or keyboard.is_new:
            raise NewEpisode
        seen.append(maps_of(tensordict["sensor"][0].cpu(), intrinsics))
        picture = next(pictures)
        image = image or axes.imshow(picture, interpolation="nearest")
        image.set_data(picture)
        title.set_text(f"{keyboard.driver} drives    {keyboard.HELP}")
        pause(max(1e-3, 1 / env.base_env.frame_rate_hz - (time.monotonic() - drawn_at)))
        drawn_at = time.monotonic()

    (episode,) = evaluate(env, keyboard, [options], on_frame=draw)
    hit = f" ({episode.hit})" if episode.hit else ""
    outcome = f"{episode.outcome.replace('_', ' ')}{hit} after {episode.length} steps"
    title.set_text(f"{outcome}, return {episode.total_reward:.2f}    {keyboard.HELP}")
    while not (keyboard.is_over or keyboard.is_new):
        pause(0.05)


def main() -> None:
    """Entry point."""
    run_command("view", run, ViewConfig)


if __name__ == "__main__":
    main()
