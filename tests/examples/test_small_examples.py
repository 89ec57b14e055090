"""The examples that need no simulator run as they stand and print what a hand gets."""

import math
from types import SimpleNamespace

import pytest
import torch


def test_a_gymnasium_env_of_ones_own_has_flow(capsys):
    pytest.importorskip("gymnasium", reason="the example is a gymnasium env")
    from torchrl.envs import check_env_specs

    from examples.gym_env import main, make_env

    env = make_env()
    check_env_specs(env)
    first = env.reset()
    assert not first["raw"].any()
    frames = env.rollout(4, policy=lambda td: td.set("action", torch.tensor(1)))["next"]
    square = frames["sensor", "instance"][:, 0] == 1
    # The camera goes 0.06 m right: the wall 6 m away goes 50 * 0.06 / 6 = 0.5 px left, the square
    # at half the distance 1 px left and, rising 0.12 m, 50 * 0.12 / 3 = 2 px up.
    for name, on_square, on_wall in [
        ("raw", (-1.0, -2.0), (-0.5, 0.0)),
        ("ego", (-1.0, 0.0), (-0.5, 0.0)),
        ("obj", (0.0, -2.0), (0.0, 0.0)),
    ]:
        flow = frames[name].movedim(1, -1)
        for mask, want in ((square, on_square), (~square, on_wall)):
            got = flow[mask]
            torch.testing.assert_close(got, torch.tensor(want).expand_as(got), atol=1e-4, rtol=0)
    main()
    assert "raw: square (-1.00, -2.00) px, wall (-0.50, " in capsys.readouterr().out


def test_the_tensors_example_prints_what_a_hand_gets(capsys):
    from examples.tensors import main

    main()
    # Column 0 has its centre 3.5 px left of the principal point, the wall was 6.5 m away: its
    # ego flow is -3.5 * (1 - 6 / 6.5) = -0.27. Column 3 (person, 0.5 px left): ego
    # -0.5 * (1 - 3 / 3.5) = -0.07; a metre to the right, seen from 3.5 m: 3 / 3.5 = +0.86.
    lines = dict(line.split(" ", 1) for line in capsys.readouterr().out.splitlines()[1:])
    columns = {name: [float(u) for u in line.split()] for name, line in lines.items()}
    assert columns["ego"][0] == -0.27
    assert columns["ego"][3] == -0.07
    assert columns["obj"] == [0, 0, 0, 0.86, 0.86, 0, 0, 0]
    assert columns["raw"][3] == pytest.approx(0.79)


@pytest.mark.parametrize("side", [1, -1])
def test_the_policy_of_ones_own_keeps_clear_of_a_person_and_comes_back(side):
    from examples.own_policy import make
    from flowrep.scenes import load_scene
    from flowrep.scenes.vehicle import YAW_SIGN, VehicleState, roll, turn

    vehicle, device = load_scene("straight_road").vehicle, torch.device("cpu")
    K = torch.tensor([[40.0, 0.0, 21.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]])
    spec = {"obj": torch.zeros(2, 30, 42)}
    act = make(SimpleNamespace(intrinsics=K, observation_spec=spec, device=device))
    state, way = VehicleState(0.0, 0.0, 0.0, 0.0), []
    for step in range(70):
        obj, depth = torch.zeros(1, 2, 30, 42), torch.ones(1, 1, 30, 42)
        if step < 20:  # 10 m ahead, 4.5 px = 1.1 m aside, and 12 steps of 0.1 px nearer when met
            column = 25 if side > 0 else 16
            obj[..., 15, column] = torch.tensor([-0.1 * side, 0.0])
            depth[..., 15, column] = 0.1
        maps = {"obj": obj, "depth": depth}
        maps |= {"env_id": torch.tensor([3]), "is_init": torch.tensor([[step == 0]])}
        (action,) = act(maps).tolist()
        state = roll(turn(state, YAW_SIGN[action], 1 / 12, vehicle), 1 / 12, vehicle.speed_mps)
        way.append(side * state.y_m)
    assert way[19] > 1.5  # with a person on the right, to the left
    assert max(way) < 2.5  # and on the road, whose edge is at 3.5 m
    assert abs(way[-1]) < 0.3
    assert abs(math.degrees(state.yaw_rad)) < 1
