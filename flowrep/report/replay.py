"""Lets trained agents drive some of their evaluated episodes again, to draw and film them."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.agent import CheckpointError
from flowrep.config import UsageError
from flowrep.envs.sensing import SENSORS
from flowrep.envs.street_env import StreetEnv
from flowrep.experiment.arena import Agent
from flowrep.experiment.run import RunFolder
from flowrep.report.drives import Drives, Film, FilmPart, Plan
from flowrep.report.families import families_of
from flowrep.report.pictures import film_uri, png_uri
from flowrep.report.runs import Condition, Run
from flowrep.report.style import words
from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout
from flowrep.subjects import load_subject
from flowrep.viz.film import Maps, maps_of
from flowrep.viz.maps import representation_strip, write_video
from flowrep.viz.plan import Track, draw_plan

_SEED = 2_000_000  # of the episodes if the runs were evaluated on none in common
_MAP_OF = {"seg": "semantic", "seg2": "semantic", "depth2": "depth"}
_PLAN_DPI = 100
_TOLD = {
    "success": "reached the end",
    "collision": "collided",
    "out_of_bounds": "left the road",
    "timeout": "ran out of time",
}

Look = Callable[[dict[str, Any]], None]


class Drive(NamedTuple):
    """One greedy episode: the vehicle's positions [T + 1, 2] in metres, outcome, steps."""

    episode_seed: int
    points_m: np.ndarray
    outcome: str
    steps: int


def drive_again(
    runs: Sequence[Run], *, trajectories: int, videos: int, device: str, trust: str | None
) -> Drives:
    """Returns plans and films of one finished agent for each scene, stack and family.

    Args:
        runs: the runs of a report.
        trajectories: the number of episodes in a plan.
        videos: the number of episodes filmed in each scene.
        device: the agents' device.
        trust: a class outside flowrep that a run's algorithm may be.
    """
    drives = Drives()
    for scene, chosen in _one_of_each(runs).items():
        seeds = _common_seeds(chosen, max(trajectories, videos))
        drivers = []
        for run in chosen:
            try:
                drivers.append(Driver(run, device, trust))
            except (CheckpointError, UsageError, ValueError, OSError) as error:
                drives.complaints.append(" ".join(str(error).split()))
        for driver in drivers:
            if trajectories:
                found = [driver.drive(seed) for seed in seeds[:trajectories]]
                drives.plans.setdefault(words(scene), []).append(_plan(driver, found))
                drives.complaints.extend(_differences(driver.run, found))
        for seed in seeds[:videos] if drivers else []:
            parts = tuple(_film(driver, seed) for driver in drivers)
            drives.films.append(Film(f"{words(scene)}, episode {seed}", parts))
        for driver in drivers:
            driver.close()
    return drives


def _one_of_each(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Returns the finished run of the lowest seed of each stack in each family, by scene."""
    by_scene: dict[str, list[Run]] = {}
    for family in families_of(runs):
        found: dict[tuple[str, str], Run] = {}
        for run in sorted(family.runs, key=lambda run: run.seed):
            if run.is_finished:
                found.setdefault((run.scene, run.stack), run)
        for (scene, _), run in found.items():
            if run not in by_scene.setdefault(scene, []):
                by_scene[scene].append(run)
    return by_scene


class Driver:
    """A run's agent in an environment of its own, at its training speed and frame rate.

    Args:
        run: the run whose checkpoint is loaded.
        device: the agent's device.
        trust: a class outside flowrep that its algorithm may be.
    """

    def __init__(self, run: Run, device: str, trust: str | None) -> None:
        asked = {"device": device, "num_envs": 1, "num_workers": 0, "trust": trust}
        self.run = run
        self._agent: Agent = load_subject(asked, RunFolder.existing(run.path)).agent
        self.scene = load_scene(run.config["scene"])
        self._eye = self._agent.eye(self.scene, run.fps)
        self._streets = {
            sensors: StreetEnv(
                self.scene, run.speed, run.fps, sensors, renderer=run.config["renderer"]
            )
            for sensors in (tuple(self._eye.sensors), SENSORS)
        }

    @torch.no_grad()
    def drive(self, episode_seed: int, look: Look | None = None) -> Drive:
        """Drives one episode, greedily.

        Args:
            episode_seed: identifies the episode.
            look: called with all sensor maps of each frame; without it only the sensors that the
                agent needs are rendered.
        """
        street = self._streets[SENSORS if look else tuple(self._eye.sensors)]
        seen, info = street.reset(options={"episode_seed": episode_seed})
        points, is_over, is_first = [street.episode.now.vehicle[:2]], False, True
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            while not is_over:
                if look:
                    look(seen)
                batch = {name: seen[name][None] for name in self._eye.sensors}
                begun, going_on = ([0], []) if is_first else ([], [0])
                action = self._agent.policy(self._eye.look(batch, begun, going_on))["action"]
                seen, _, is_over, _, info = street.step(int(action[0]))
                points.append(street.episode.now.vehicle[:2])
                is_first = False
        if look:
            look(seen)
        return Drive(episode_seed, np.array(points, float), info["outcome"], street.episode.steps)

    def film(self, episode_seed: int) -> tuple[Drive, list[Maps]]:
        """Drives one episode and returns it with the maps of its sensors."""
        frames: list[Maps] = []
        intrinsics = torch.as_tensor(self._streets[SENSORS].K)

        def look(seen: dict[str, Any]) -> None:
            maps = {name: torch.as_tensor(np.array(value)) for name, value in seen.items()}
            frames.append(maps_of(maps, intrinsics))

        return self.drive(episode_seed, look), frames

    def close(self) -> None:
        """Closes the simulator."""
        for street in self._streets.values():
            street.close()


def _common_seeds(runs: Sequence[Run], count: int) -> list[int]:
    """Returns seeds of episodes that all runs were evaluated on, or fixed ones if none are."""
    driven = []
    for run in runs:
        rows = run.by_condition.get(Condition("greedy", run.speed, run.fps), [])
        driven.append({int(row["episode_seed"]) for row in rows})
    return [*sorted(set.intersection(*driven)), *range(_SEED, _SEED + count)][:count]


def _plan(driver: Driver, drives: Sequence[Drive]) -> Plan:
    tracks = [Track(drive.points_m, drive.outcome) for drive in drives]
    figure = draw_plan(Layout(driver.scene), tracks)
    counts = Counter(drive.outcome for drive in drives)
    told = ", ".join(f"{counts[name]} {text}" for name, text in _TOLD.items() if counts[name])
    return Plan(_title(driver.run), f"of {len(drives)}, {told}", png_uri(figure, _PLAN_DPI))


def _title(run: Run) -> str:
    return f"{run.stack}, seed {run.seed} ({run.path.name})"


def _film(driver: Driver, seed: int) -> FilmPart:
    drive, frames = driver.film(seed)
    run = driver.run
    shown = {"rgb", *(_MAP_OF.get(name, name) for name in run.config["representations"])}
    strips = [
        representation_strip({name: maps[name] for name in shown if name in maps})
        for maps in frames
    ]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_video(path, strips, fps=run.fps)
        told = f"{_TOLD[drive.outcome]} after {drive.steps / run.fps:.1f} s"
        if run.config["flow"]["source"] != "exact":
            told += "; flow is shown exact, the agent sees an estimate"
        if any(run.config["noise"].values()):
            told += "; sensors are shown exact, the agent's have noise"
        return FilmPart(_title(run), told, film_uri(path))


def _differences(run: Run, drives: Sequence[Drive]) -> list[str]:
    """Returns a line if an agent drives differently from its evaluation.csv."""
    rows = run.by_condition.get(Condition("greedy", run.speed, run.fps), [])
    then = {int(row["episode_seed"]): (row["outcome"], int(row["length"])) for row in rows}
    changed = [
        drive
        for drive in drives
        if then.get(drive.episode_seed, (drive.outcome, drive.steps))
        != (drive.outcome, drive.steps)
    ]
    if not changed:
        return []
    return [
        f"{run.path} drives {len(changed)} of {len(drives)} episodes otherwise here than in its "
        "evaluation.csv: another machine, version or weights"
    ]
