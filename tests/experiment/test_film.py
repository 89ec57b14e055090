"""Films of episodes and the learning curve."""

from functools import partial

import pytest
import torch

pytest.importorskip("pybullet", reason="the simulated street is driven")

from flowrep.envs import make_env, street_envs
from flowrep.experiment.film import (
    draw_learning_curve,
    film_episode,
    make_filmed,
    maps_of,
    record_episode,
)
from flowrep.policies import load_agent
from tests.config.composing import composed


def leave_the_road(tensordict):
    return tensordict.set("action", torch.ones(len(tensordict), dtype=torch.int64))


def test_a_film_is_of_the_episode_that_names_it():
    env, sensors = make_filmed(partial(make_env, "straight_road"), {"seg": {}}), []
    frames, episode = film_episode(
        env, leave_the_road, {"episode_seed": 2_000_017}, on_frame=sensors.append
    )
    assert street_envs(env)[0].episode.seed == episode.seed == 2_000_017
    assert episode.outcome == "out_of_bounds"
    assert len(frames) == len(sensors) == episode.length + 1
    intrinsics = torch.as_tensor(street_envs(env)[0].K)
    for name, drawn in maps_of(sensors[3], intrinsics).items():
        assert torch.equal(drawn, frames[3][name])
    torch.testing.assert_close(frames[3]["raw"], frames[3]["ego"] + frames[3]["obj"])
    env.close()


@pytest.mark.parametrize(
    ("representation", "flow", "rgb"),
    [
        ("seg", "exact", (3, 252, 252)),  # three times the maps, as large as a film's tiles
        ("rgb", "exact", (3, 84, 84)),  # the agent sees it
        ("obj", "estimated", (3, 84, 84)),  # flow is estimated from it
    ],
)
def test_the_picture_is_large_unless_something_else_reads_it(representation, flow, rgb):
    make = partial(make_env, "straight_road", flow=flow)
    env = make_filmed(make, {representation: {}})
    assert env.observation_spec["sensor", "rgb"].shape == (1, *rgb)
    env.close()


@pytest.mark.slow
def test_a_recorded_episode_is_a_whole_film(tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    path, scene = tmp_path / "episode.mp4", composed("debug=smoke").scene
    agent = load_agent("random", scene=scene, device="cpu", num_envs=1, num_workers=0)
    episode = record_episode(agent, path, episode_seed=3, frame_rate_hz=6.0)
    assert episode.fps == 6.0
    assert len(imageio.imread(path, plugin="FFMPEG")) == episode.length + 1
    assert [file.name for file in tmp_path.iterdir()] == ["episode.mp4"]


def test_the_curve_shows_the_runs_own_greedy_evaluations_at_its_own_speed(tmp_path, monkeypatch):
    from matplotlib.axes import Axes

    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda self, x, y, *_, **__: drawn.append((x, y)))
    row = {"evaluation": "training", "policy": "greedy", "speed": "normal", "fps": "12.0"}
    row |= {"frames": "100", "outcome": "success"}
    others = {"evaluation": "evaluate", "policy": "sampled", "speed": "low", "fps": "6.0"}
    rows = [row, row | {"outcome": "timeout"}, row | {"evaluation": "final", "frames": "200"}]
    rows += [row | {key: value} for key, value in others.items()]
    rows.append(row | {"frames": "200", "outcome": "timeout"})  # other episodes than the final ones
    metrics = [{"frames": "50", "success": "0.5"}, {"frames": "100", "success": "nan"}]
    for points, episodes in ((metrics, rows), ([], [])):
        draw_learning_curve(tmp_path / "a.png", points, episodes, speed="normal", fps=12.0)
    assert drawn == [(100, 0.5), (200, 1.0)]
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
