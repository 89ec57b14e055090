"""The example's states and labels; that teacher and student learn, in a few updates."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from examples import distillation
from flowrep.envs import StreetEnv, make_env
from flowrep.scenes import load_scene
from flowrep.scenes.vehicle import VehicleState


def test_a_state_has_the_nearest_people_in_the_vehicles_axes():
    # The vehicle heads along y; one person walks along x at 1 m/s, another stands ahead of them,
    # one is too far behind and one too far away.
    start = np.array([[48.0, 10.0], [51.0, 24.0], [50.0, -1.0], [50.0, 40.0]])
    walk = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    vehicle = VehicleState(50.0, 4.0, math.pi / 2, 0.5)
    episode = SimpleNamespace(
        now=SimpleNamespace(vehicle=vehicle, ticks=6),
        tick_s=0.5,
        crowd=SimpleNamespace(positions=lambda time_s: start + (time_s - 3.0) * walk),
    )
    state = distillation.state_of(episode)
    assert state[:5] == pytest.approx([1.0, 1.0, 3.0, 0.0, 0.5], abs=1e-6)
    # 6 m ahead and 2 m to the left, walking to the right; 20 m ahead and 1 m to the right
    assert state[5:10] == pytest.approx([0.6, 0.2, 0.0, -0.5, 1.0], abs=1e-6)
    assert state[10:15] == pytest.approx([2.0, -0.1, 0.0, 0.0, 1.0], abs=1e-6)
    assert not state[15:].any()


def test_values_in_the_mirror_image_are_those_of_the_mirrored_actions():
    torch.manual_seed(0)
    teacher = nn.ModuleList(distillation.StateQ() for _ in range(2))
    state = torch.randn(4, len(distillation.SIGNS))
    keep, left, right = distillation.values(teacher, state).unbind(1)
    image = distillation.values(teacher, state * distillation.SIGNS)
    assert not torch.allclose(left, right)
    assert torch.allclose(image, torch.stack([keep, right, left], 1), atol=1e-6)


def test_the_teacher_learns_that_driving_at_random_ends_badly():
    scene = load_scene("straight_road")
    teacher = distillation.train_teacher(scene, 5120, seed=0)
    env = StreetEnv(scene, sensors=())
    env.begin(seed=1)
    state = torch.from_numpy(distillation.state_of(env.episode))[None]
    untrained = nn.ModuleList(distillation.StateQ() for _ in range(2))
    assert distillation.values(untrained, state).abs().max() < 0.15
    assert distillation.values(teacher, state).max() < -0.2


def test_the_student_learns_the_teachers_choice_and_takes_it():
    class Prefers(nn.Module):
        def forward(self, state):
            return torch.tensor([0.0, 1.0, 1.0]).expand(len(state), 3)

    scene = load_scene("straight_road")
    scene = replace(scene, camera=replace(scene.camera, height_px=36, width_px=36))
    teacher = nn.ModuleList([Prefers(), Prefers()])
    student = distillation.distil(teacher, scene, ["obj"], [0.6, 2.4], 32 * 40, seed=0)
    env = make_env(scene, ["obj"], num_envs=2, seed=5)
    probability = student.get_dist(env.reset()).probs[:, 0]
    env.close()
    assert probability.max() < 0.05  # of not turning, a third in the beginning
    shares = distillation.success(student, scene, ["obj"], episodes=2)
    assert shares == {"low": 0.0, "normal": 0.0, "high": 0.0}  # it turns all the time
