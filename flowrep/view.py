"""Shows a scene and how a policy drives in it: `python -m flowrep.view scene=s_turn`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrep.extras import require

require("viewing", "train", "hydra", "pydantic", "matplotlib", "imageio_ffmpeg", module=__name__)

from flowrep.config.cli import run_command
from flowrep.config.run_names import folder_name
from flowrep.config.usage import UsageError
from flowrep.experiment.policies import policy_of
from flowrep.experiment.schema import ViewConfig
from flowrep.files import replace_file
from flowrep.progress import progress_bar
from flowrep.viz import contact_sheet, write_png, write_video

if TYPE_CHECKING:
    from flowrep.experiment.agents import Agent
    from flowrep.experiment.film import Film
    from flowrep.experiment.outcomes import EpisodeRecord
    from flowrep.scenes import Scene

ENVS = 16  # side by side, for the episodes that are not filmed
FILES = ("sheet.png", "episode.mp4", "plan.png")
"""The files of a view; a new view replaces all of them."""


def run(config: ViewConfig) -> None:
    """Writes pictures and a film of the scene."""
    policy_of(config.policy)  # refuses a wrong name before PyTorch is imported

    from flowrep.experiment.film import Film

    agent = agent_of(config)
    with closing(Film(agent, **street_of(config))) as film:
        view(config, agent, film)


def agent_of(config: ViewConfig) -> Agent:
    """Returns what drives."""
    from flowrep.experiment.agents import Agent

    return Agent.load(
        config.policy,
        scene=config.scene,
        representations=config.representations,
        trusted=config.trusted,
        device="cpu",
        num_envs=1,
    )


def street_of(config: ViewConfig) -> dict[str, Any]:
    """Returns what the config asks of the agent's env."""
    return {"speed": config.speed, "frame_rate_hz": config.fps}


def folder_of(config: ViewConfig, scene: Scene) -> Path:
    """Returns the folder of a view: one for each scene and policy, unless another is given."""
    default = Path("outputs", "view", folder_name(scene.name), folder_name(config.policy))
    return default if config.output is None else Path(config.output)


def episodes_of(config: ViewConfig, scene: Scene) -> list[dict[str, Any]]:
    """Returns the options of the episodes to view."""
    paths = [path.name for path in scene.paths]
    if config.path not in (*paths, None):
        raise UsageError(f"path should be {', '.join(paths)} or null, not '{config.path}'")
    path = {} if config.path is None else {"path": config.path}
    seeds = range(config.seed, config.seed + config.episodes)
    return [{"episode_seed": seed, "speed": config.speed} | path for seed in seeds]


def view(config: ViewConfig, agent: Agent, film: Film) -> None:
    """Drives episodes and writes their pictures, plan and film into a folder."""
    from flowrep.experiment.outcomes import print_table
    from flowrep.scenes.layout import Layout
    from flowrep.viz.plan import Track, draw_plan

    scene = film.street.scene
    options, folder = episodes_of(config, scene), folder_of(config, scene)
    with progress_bar(what="driving", unit="frame") as bar:
        frames, episode = film.drive(options[0], lambda _: bar.update())
    episodes = [episode, *drive_on(config, agent, options[1:])]
    tracks = [Track(each.positions.astype(float), each.outcome) for each in episodes]
    # Closed exits belong to a path; they are drawn if all episodes took the same one.
    path = episode.path if all(each.path == episode.path for each in episodes) else None
    folder.mkdir(parents=True, exist_ok=True)
    chosen = moments([moving_pixels(frame.maps) for frame in frames], config.sheet_rows)
    write_png(folder / "sheet.png", contact_sheet(film.draw(frames[i]) for i in chosen))
    if config.video:
        pictures = progress_bar(film.pictures(frames, episode), what="drawing", unit="frame")
        write_video(folder / "episode.mp4", pictures, fps=episode.fps)
    else:  # an earlier view may have had one
        (folder / "episode.mp4").unlink(missing_ok=True)
    with replace_file(folder / "plan.png") as partial:
        draw_plan(Layout(scene), tracks, path=path).savefig(partial, dpi=110)
    shown = ("path", "episode_seed", "outcome", "hit", "return", "length")
    rows = [each.row() for each in episodes]
    print_table("episodes", [{name: row[name] for name in shown} for row in rows])
    arrived = sum(each.outcome == "success" for each in episodes)
    print(f"{config.policy}: {arrived} of {len(episodes)} episodes end in success")
    print(f"{folder}: {', '.join(each for each in FILES if (folder / each).is_file())}")


def drive_on(
    config: ViewConfig, agent: Agent, options: list[dict[str, Any]]
) -> list[EpisodeRecord]:
    """Returns the episodes after the first, in their order; only the policy's maps are drawn."""
    from flowrep.experiment.evaluation import evaluate

    if not options:
        return []
    with closing(agent.make_env(**street_of(config), num_envs=min(ENVS, len(options)))) as env:
        ended = evaluate(env, agent.policy, options)
        counted = progress_bar(ended, what="driving on", unit="episode", total=len(options))
        episodes = list(counted)
    return sorted(episodes, key=lambda episode: episode.episode_seed)


def moving_pixels(maps: Mapping[str, Any]) -> int:
    """Returns how many pixels show a moving object more than 4 m from the camera."""
    return int(((maps["obj"] != 0).any(0) & (maps["depth"][0] > 4.0)).sum())


def moments(motion: list[int], count: int) -> list[int]:
    """Returns frame indices for a contact sheet: the one with most motion in each of `count` parts.

    >>> moments([0, 0, 3, 1, 0, 0, 0, 2], 2)
    [2, 7]
    """
    ends = [round(i * len(motion) / count) for i in range(count + 1)]
    return [max(range(a, b), key=lambda i: motion[i]) for a, b in pairwise(ends) if b > a]


def main() -> None:
    """Entry point."""
    run_command("view", run, ViewConfig)


if __name__ == "__main__":
    main()
