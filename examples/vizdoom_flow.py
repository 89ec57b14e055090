"""Ego and object flow in Doom, where monsters come and go: ViZDoom.

    pip install '.[examples]'
    python examples/vizdoom_flow.py strip.png

ViZDoom's documentation doesn't state its conventions. They were measured by casting rays through
its maps; tests/examples/test_other_simulators.py checks them by warping frames with the flow:

- 32 map units are a metre, and depth is a byte, linear in z: 7.16 · (byte + 2) units on floors and
  ceilings, which have label 1, and 7.16 · (byte + 1.19) on walls and sprites at 240 rows;
- the field of view is 90° across the width, and pixels are 1.2 times as wide as tall;
- labels change from frame to frame; `state.labels` says which object each label stands for;
- sprites are billboards that always face the camera, so a body's pose is its position alone;
- after the last step there is no state.
"""

import os
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import vizdoom
from gymnasium import spaces
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from flowrep.geometry import intrinsics_from_fov
from flowrep.transforms import (
    AdaptPose,
    BodyRows,
    CameraMotion,
    FlowFactorize,
    InstanceMotion,
    RawFlow,
)

HEIGHT, WIDTH, SKIP, BODIES = 240, 320, 2, 32
UNITS_PER_M = 32.0
K = intrinsics_from_fov(90.0, axis="horizontal", height=HEIGHT, width=WIDTH, pixel_aspect=1.2)
CAMERA = ("CAMERA_POSITION_X", "CAMERA_POSITION_Y", "CAMERA_POSITION_Z", "CAMERA_ANGLE")


class Doom(gym.Env):
    """A scenario of ViZDoom; an action presses one of its buttons, or none."""

    def __init__(self, scenario: str = "defend_the_line") -> None:
        self.game = vizdoom.DoomGame()
        self.game.load_config(os.path.join(vizdoom.scenarios_path, f"{scenario}.cfg"))
        self.game.set_window_visible(False)
        self.game.set_screen_resolution(vizdoom.ScreenResolution.RES_320X240)
        self.game.set_screen_format(vizdoom.ScreenFormat.CRCGCB)  # channels first
        for enable in ("depth_buffer", "labels_buffer"):
            getattr(self.game, f"set_{enable}_enabled")(True)
        # These are not part of depth.
        for hide in ("hud", "weapon", "crosshair", "particles", "decals"):
            getattr(self.game, f"set_render_{hide}")(False)
        variables = [getattr(vizdoom.GameVariable, name) for name in CAMERA]
        self.game.set_available_game_variables(variables)
        self.game.init()
        self.rows = BodyRows(BODIES)
        self.buttons = np.eye(self.game.get_available_buttons_size()).tolist()
        self.action_space = spaces.Discrete(len(self.buttons))
        self.observation_space = spaces.Dict(
            sensor=spaces.Dict(
                rgb=spaces.Box(0, 255, (3, HEIGHT, WIDTH), np.uint8),
                depth=spaces.Box(0.0, np.inf, (1, HEIGHT, WIDTH), np.float32),
                instance=spaces.Box(0, BODIES, (1, HEIGHT, WIDTH), np.uint8),
                world_from_body=spaces.Box(-np.inf, np.inf, (BODIES, 4, 4), np.float64),
            ),
            camera_pose=spaces.Box(-np.inf, np.inf, (4,), np.float64),
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.game.set_seed(seed % (1 << 31))
        self.game.new_episode()
        self.rows.clear()
        self.latest = self.observe()
        return copied(self.latest), {}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        reward = self.game.make_action(self.buttons[int(action)], SKIP)
        ended = self.game.is_episode_finished()
        if not ended:
            self.latest = self.observe()
        return copied(self.latest), reward, ended, False, {}

    def observe(self) -> dict[str, Any]:
        """Returns this step's maps and poses, in flowrep's conventions."""
        state = self.game.get_state()
        *place, angle_deg = state.game_variables
        camera_pose = np.array([*np.divide(place, UNITS_PER_M), np.deg2rad(angle_deg)])
        labels = torch.from_numpy(state.labels_buffer)
        offset = np.where(state.labels_buffer == 1, 2.0, 1.19)
        bodies = {each.object_id: each for each in state.labels if each.object_name != "DoomPlayer"}
        poses = {}
        for number, body in bodies.items():
            poses[number] = torch.eye(4, dtype=torch.float64)
            place = body.object_position_x, body.object_position_y, body.object_position_z
            poses[number][:3, 3] = torch.tensor(place) / UNITS_PER_M
        world_from_body = self.rows(poses).numpy()
        instance = self.rows.instance(labels, {body.value: i for i, body in bodies.items()})
        depth = 7.16 * (state.depth_buffer + offset) / UNITS_PER_M
        sensor = {
            "rgb": state.screen_buffer,
            "depth": depth[None].astype(np.float32),
            "instance": instance[None].numpy(),
            "world_from_body": world_from_body,
        }
        return {"sensor": sensor, "camera_pose": camera_pose}

    def close(self) -> None:
        self.game.close()


def copied(observation: dict[str, Any]) -> dict[str, Any]:
    """Returns a copy, because transforms write into what an env returns."""
    return observation | {"sensor": dict(observation["sensor"])}


def make_env(scenario: str = "defend_the_line") -> TransformedEnv:
    """Returns a scenario as a TorchRL env that writes raw, ego and obj."""
    transforms = Compose(
        AdaptPose(layout="xyz_yaw", axes="x_forward_z_up", in_keys="camera_pose"),
        CameraMotion(),
        InstanceMotion(),
        RawFlow(K),
        FlowFactorize(K),
    )
    return TransformedEnv(GymWrapper(Doom(scenario), categorical_action_encoding=True), transforms)


def main(path: str | None = None) -> None:
    from flowrep import diagnose

    env = make_env()
    env.set_seed(1)
    frames = env.rollout(40)["next"]
    print(diagnose(frames[:-1], K))
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[len(frames) // 2]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=20.0))
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
