"""Shows a scene: `python -m flowrep.view scene=s_turn`, or drives it: `interactive=true`."""

from itertools import pairwise
from pathlib import Path
from typing import Any

from flowrep.extras import require

require("viewing", "train", "hydra", "pydantic", module=__name__)

import torch
from hydra.core.hydra_config import HydraConfig
from rich import box
from rich.console import Console
from rich.table import Table
from tqdm.auto import tqdm

from flowrep.baselines import BASELINES
from flowrep.config import UsageError
from flowrep.config.cli import run_command
from flowrep.config.schema import ViewConfig
from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS
from flowrep.experiment.viewing import CategoryCount, Viewed, view_episode
from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout
from flowrep.tables import append_rows
from flowrep.viz import contact_sheet, representation_strip, write_png, write_video
from flowrep.viz.film import Maps, maps_of
from flowrep.viz.plan import Track, draw_plan
from flowrep.viz.window import KeyboardDriver, drive_by_hand


def run(config: ViewConfig) -> None:
    """Writes pictures, a video and tables of the scene, or opens a window on it."""
    check(config)
    street: dict[str, Any] = {
        "scene": config.scene,
        "speed": config.speed,
        "frame_rate_hz": config.frame_rate_hz,
    }
    if config.interactive:
        env = StreetEnv(**street, sensors=SENSORS)
        drive_by_hand(KeyboardDriver(env, seed=config.seed, path=config.path))
    else:
        look_at(config, street, Path(HydraConfig.get().runtime.output_dir))


def check(config: ViewConfig) -> None:
    """Checks that the scene is valid and has the path.

    Raises:
        UsageError: it has no such path.
        SceneError: the scene is invalid.
    """
    paths = [path.name for path in load_scene(config.scene).paths]
    if config.path not in (*paths, None):
        raise UsageError(f"path should be {', '.join(paths)} or null, not '{config.path}'")


def look_at(config: ViewConfig, street: dict[str, Any], folder: Path) -> None:
    """Drives the episodes and writes their pictures, plan, video and tables."""
    frames, first, counts, fps = film(config, street)
    others = drive_on(config, street, config.episodes - 1)
    episodes = [first, *others]
    strips = [representation_strip(maps) for maps in tqdm(frames, desc="drawing", unit="frame")]
    chosen = moments([moving_pixels(maps) for maps in frames], config.sheet_rows)
    write_png(folder / "sheet.png", contact_sheet(strips[i] for i in chosen))
    written = ["sheet.png", "plan.png", "episodes.csv", "categories.csv"]
    if config.video:
        write_video(folder / "episode.mp4", strips, fps=fps)
        written.insert(1, "episode.mp4")
    layout = Layout(StreetEnv(**street, sensors=()).scene)
    tracks = [Track(episode.points_m, episode.outcome) for episode in episodes]
    paths = {episode.path for episode in episodes}
    # Closed exits belong to a path; they are drawn if all episodes took the same one.
    path = paths.pop() if len(paths) == 1 else None
    draw_plan(layout, tracks, path=path).savefig(folder / "plan.png", dpi=110)
    for name, rows in (
        ("episodes.csv", [episode.row() for episode in episodes]),
        ("categories.csv", counts.rows()),
    ):
        (folder / name).unlink(missing_ok=True)
        append_rows(folder / name, rows)
        print_rows(name.removesuffix(".csv"), rows)
    print(f"{folder}: {', '.join(written)}")


def film(
    config: ViewConfig, street: dict[str, Any]
) -> tuple[list[Maps], Viewed, CategoryCount, float]:
    """Returns the first episode's maps, the drive, its category counts and its frame rate."""
    env = StreetEnv(**street, sensors=SENSORS)
    intrinsics, frames = torch.as_tensor(env.K), []
    counts = CategoryCount(env.scene.categories)
    with tqdm(desc="driving", unit="frame") as bar:

        def look(observation: Any) -> None:
            counts(observation)
            maps = {name: torch.as_tensor(value) for name, value in observation.items()}
            frames.append(maps_of(maps, intrinsics))
            bar.update()

        baseline = BASELINES[config.policy]()
        first = view_episode(env, baseline, look=look, seed=config.seed, path=config.path)
    env.close()
    return frames, first, counts, env.frame_rate_hz


def drive_on(config: ViewConfig, street: dict[str, Any], episodes: int) -> list[Viewed]:
    """Returns the episodes after the first, driven without rendering."""
    env, baseline = StreetEnv(**street, sensors=()), BASELINES[config.policy]()
    env.reset(seed=config.seed)
    viewed = [
        view_episode(env, baseline, path=config.path)
        for _ in tqdm(range(episodes), desc="driving on", unit="episode")
    ]
    env.close()
    return viewed


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


def print_rows(title: str, rows: list[dict[str, Any]]) -> None:
    """Prints rows as a table."""
    table = Table(title=title, box=box.SIMPLE, pad_edge=False)
    for name in rows[0]:
        table.add_column(name.replace("_", " "), no_wrap=True)
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    Console().print(table)


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    run_command("view", run, ViewConfig)


if __name__ == "__main__":
    main()
