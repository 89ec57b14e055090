"""Videos of an episode: the camera's picture and every representation, side by side."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.envs import street_envs
from flowrep.experiment.evaluation import OUTCOMES, Policy
from flowrep.geometry import factorize, rigid_flow
from flowrep.viz.maps import representation_strip, write_video

Maps = dict[str, Tensor]


@torch.no_grad()
def film_episode(
    env: EnvBase, policy: Policy, episode_seed: int | None = None
) -> tuple[list[Maps], str]:
    """Returns the maps of every frame of one greedy episode, and its outcome.

    Args:
        env: a batch of one environment that keeps all sensors and rgb.
        policy: writes `action`.
        episode_seed: identifies the episode, as in evaluation.csv; the env's next one if None.
    """
    intrinsics = torch.as_tensor(street_envs(env)[0].K)
    chosen = {} if episode_seed is None else {"options": {"episode_seed": episode_seed}}
    tensordict = env.reset(**chosen)
    frames = [maps_of(tensordict["sensor"][0].cpu(), intrinsics)]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while not tensordict["done"].any():
            tensordict = env.step(policy(tensordict))["next"]
            frames.append(maps_of(tensordict["sensor"][0].cpu(), intrinsics))
    return frames, OUTCOMES[int(tensordict["outcome"])]


def maps_of(sensor: Mapping[str, Any], intrinsics: Tensor) -> Maps:
    """Returns rgb, semantic, depth, raw, ego and obj `[C, H, W]` from one env's sensors.

    Flow is in px/step, whatever the unit and scale of the agent's own representations. If the agent
    uses estimated flow or noisy depth, so do these maps.
    """
    raw = measured = sensor.get("flow", None)
    if raw is None:
        exact, instance = sensor["depth"], sensor["instance"]
        measured = rigid_flow(exact, instance, intrinsics, sensor["instance_motion"])
        raw = measured.flow
    depth = sensor.get("noisy_depth", sensor["depth"])
    motion = sensor.get("noisy_motion", sensor["prev_from_curr"])
    ego, obj, _ = factorize(measured, depth, intrinsics, motion)
    return {
        "rgb": sensor["rgb"],
        "semantic": sensor["semantic"],
        "depth": depth,
        "raw": raw,
        "ego": ego,
        "obj": obj,
    }


def record_episode(
    make_env: Callable[..., EnvBase],
    policy: Policy,
    representations: Mapping[str, Any],
    path: Path,
    *,
    episode_seed: int,
) -> str:
    """Writes the video of one greedy episode to `path`; returns its outcome.

    Args:
        make_env: called with `representations`, `keep_sensor`, `num_envs` and `num_workers`.
        policy: writes `action`.
        representations: the policy's inputs, a mapping from name to options.
        path: the mp4 file.
        episode_seed: identifies the episode, as in evaluation.csv.
    """
    seen = dict(representations) | {"rgb": {}}
    env = make_env(representations=seen, keep_sensor=True, num_envs=1, num_workers=0)
    frames, outcome = film_episode(env, policy, episode_seed)
    fps = street_envs(env)[0].frame_rate_hz
    env.close()
    whole = path.with_suffix(f".tmp{path.suffix}")  # so that `path` is never half a film
    write_video(whole, [representation_strip(maps) for maps in frames], fps=fps)
    whole.replace(path)
    return outcome
