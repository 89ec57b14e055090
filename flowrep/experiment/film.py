"""Films of episodes, and the picture of a run's learning."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from flowrep.envs import street_envs
from flowrep.experiment.agents import Agent
from flowrep.experiment.evaluation import Episode, Policy, evaluate, outcome_shares
from flowrep.experiment.run import replace_file
from flowrep.geometry import factorize, rigid_flow
from flowrep.viz import representation_strip, write_video
from flowrep.viz.maps import tile_zoom

Maps = dict[str, Tensor]


def make_filmed(make_env: Callable[..., EnvBase], representations: Mapping[str, Any]) -> EnvBase:
    """Returns an env of one street for `film_episode`: it keeps every sensor, rgb included.

    Unless the agent or an estimator sees it too, rgb is as large as the tiles of a film.
    """
    seen = {**representations, "rgb": {}}
    make = partial(make_env, representations=seen, keep_sensor=True, num_envs=1, num_workers=0)
    env = make()
    is_for_us = (
        "rgb" not in representations
        and sum(("sensor", "rgb") in transform.in_keys for transform in env.transform) == 1
    )
    (street,) = street_envs(env)
    if not is_for_us or street.sensing.renderer == "pybullet":
        return env
    size = env.observation_spec["sensor", "rgb"].shape[-2:]
    env.close()
    return make(picture_scale=tile_zoom(*size))


def film_episode(
    env: EnvBase,
    policy: Policy | str,
    options: Mapping[str, Any],
    on_frame: Callable[[TensorDictBase], None] = lambda tensordict: None,
) -> tuple[list[Maps], Episode]:
    """Returns the maps of every frame of one greedy episode, and the episode.

    `env` is of `make_filmed`, `options` are of `StreetEnv.reset`, and `on_frame` gets the sensors.
    """
    intrinsics = torch.as_tensor(street_envs(env)[0].K)
    frames: list[Maps] = []

    def keep(tensordict: TensorDictBase) -> None:
        sensor = tensordict["sensor"][0].cpu()
        frames.append(maps_of(sensor, intrinsics))
        on_frame(sensor)

    (episode,) = evaluate(env, policy, [options], on_frame=keep)
    return frames, episode


def maps_of(sensor: Mapping[str, Any] | TensorDictBase, intrinsics: Tensor) -> Maps:
    """Returns rgb, semantic, depth, raw, ego and obj `[C, H, W]` from one env's sensors.

    Flow is in px/step, and as estimated or noisy as the agent's own.
    """
    raw = measured = sensor.get("flow", None)
    if raw is None:
        exact, instance = sensor["depth"], sensor["instance"]
        measured = rigid_flow(exact, instance, intrinsics, sensor["instance_motion"])
        raw = measured.flow
    depth = sensor.get("noisy_depth", sensor["depth"])
    told = sensor.get("noisy_motion", sensor["prev_from_curr"])
    motion = sensor.get("estimated_motion", told)
    ego, obj, _ = factorize(measured, depth, intrinsics, motion)
    seen = {"rgb": sensor["rgb"], "semantic": sensor["semantic"]}
    return seen | {"depth": depth, "raw": raw, "ego": ego, "obj": obj}


def draw_frames(frames: Iterable[Maps], env: EnvBase) -> Iterator[Any]:
    """Yields the pictures of an env's film, with the time and the colours of its classes."""
    (street,) = street_envs(env)
    for number, maps in enumerate(frames):
        time_s = number / street.frame_rate_hz
        yield representation_strip(maps, categories=street.scene.categories, time_s=time_s)


def record_episode(agent: Agent, path: Path, *, episode_seed: int, **changes: Any) -> Episode:
    """Writes the video of one greedy episode; `changes` are of the arguments of `make_env`."""
    env = make_filmed(partial(agent.make_env, **changes), agent.config.representations)
    frames, episode = film_episode(env, agent.policy, {"episode_seed": episode_seed})
    replace_file(path, partial(write_video, frames=draw_frames(frames, env), fps=episode.fps))
    env.close()
    return episode


def draw_learning_curve(
    path: Path,
    metrics: Iterable[Mapping[str, str]],
    episodes: Iterable[Mapping[str, str]],
    *,
    speed: str,
    fps: float,
) -> None:
    """Draws a run's success over frames, from the rows of metrics.csv and evaluation.csv.

    The line is the success rate over the last training episodes (sampled actions); the points are
    the run's own greedy evaluations at its speed and frame rate, with 95 % Wilson intervals. After
    the same frames the final one counts, not with other episodes that one in training drove.
    """
    from matplotlib.figure import Figure  # a tenth of the time that a command takes to start

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(
        xlabel="environment frames", ylabel="share of episodes that succeed", ylim=(0, 1)
    )
    points = [(int(row["frames"]), float(row["success"])) for row in metrics]
    axes.plot(*zip(*points) if points else ([], []), label="training, sampled actions")
    outcomes: dict[str, dict[int, list[str]]] = {kind: {} for kind in ("training", "final")}
    for row in episodes:
        is_own = row["evaluation"] in outcomes and row["policy"] == "greedy"
        if is_own and (row["speed"], float(row["fps"])) == (speed, fps):
            of_kind = outcomes[row["evaluation"]]
            of_kind.setdefault(int(row["frames"]), []).append(row["outcome"])
    evaluations = outcomes["training"] | outcomes["final"]
    for number, (frames, names) in enumerate(sorted(evaluations.items())):
        share, low, high = outcome_shares(names)["success"]
        axes.errorbar(
            frames,
            share,
            [[share - low], [high - share]],
            fmt="o",
            color="C1",
            capsize=3,
            clip_on=False,  # an agent may succeed always
            label=None if number else "evaluation, greedy actions",
        )
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)  # covers no curve
    axes.grid(alpha=0.3)
    replace_file(path, partial(figure.savefig, dpi=120, format="png"))
