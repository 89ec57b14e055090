"""The examples that need no simulator run as they stand and print what a hand gets."""

import pytest
import torch


def test_a_gymnasium_env_of_ones_own_has_flow():
    pytest.importorskip("gymnasium", reason="the example is a gymnasium env")
    from torchrl.envs import check_env_specs

    from examples.gym_env import make_env

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


def test_the_gymnasium_example_prints_it(capsys):
    pytest.importorskip("gymnasium", reason="the example is a gymnasium env")
    from examples.gym_env import main

    main()
    printed = capsys.readouterr().out
    assert "raw: square (-1.00, -2.00) px, wall (-0.50, " in printed
    assert "obj: square (+0.00, -2.00) px" in printed


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
