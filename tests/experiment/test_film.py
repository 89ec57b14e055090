"""Films of episodes."""

import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from flowrep.experiment.agents import Agent
from flowrep.experiment.film import Film, record_episode
from flowrep.transforms import Depth
from flowrep.viz import OUTCOME_COLOURS
from tests.config.composing import composed


def leave_the_road(tensordict):
    return tensordict.set("action", torch.ones(len(tensordict), dtype=torch.int64))


@pytest.fixture
def film_of(close_later):
    """Films an agent of a config that leaves the road to the left; closed when the test ends."""

    def film_of(*overrides, **changes):
        config = composed("debug=smoke", "device=cpu", *overrides).model_copy(update=changes)
        return close_later(Film(Agent(leave_the_road, config)))

    return film_of


def test_a_drive_has_a_frame_for_each_step_of_the_episode_that_was_asked_for(film_of):
    film, sensors = film_of("representations=[seg]"), []
    frames, episode = film.drive(
        {"episode_seed": 2_000_017}, lambda tensordict: sensors.append(tensordict["sensor"][0])
    )
    assert film.street.episode.seed == episode.episode_seed == 2_000_017
    assert episode.outcome == "out_of_bounds"
    assert len(frames) == len(sensors) == episode.length + 1
    assert [frame.steps for frame in frames] == [*range(episode.length + 1)]
    # with the frame in which the episode has ended, where nothing is decided any more
    assert [frame.action for frame in frames] == [1] * episode.length + [None]


def test_maps_that_the_agent_does_not_read_are_exact(film_of):
    film, last = film_of("representations=[seg]"), []
    frames, _ = film.drive(
        {"episode_seed": 3}, lambda tensordict: last.append(tensordict["sensor"][0].clone())
    )
    maps, sensor = frames[9].maps, last[9]
    assert film.framed == ["seg"]
    assert torch.equal(maps["seg"], sensor["semantic"])
    near = sensor["depth"] < 99.9
    torch.testing.assert_close(maps["depth"][near], sensor["depth"][near])
    assert maps["depth"][sensor["depth"].isinf()].isinf().all()
    torch.testing.assert_close(maps["raw"], maps["ego"] + maps["obj"])
    assert maps["ego"].abs().max() > 0.1


def test_maps_that_the_agent_reads_are_in_units_and_keep_their_noise(film_of):
    options = "representations.obj.scale=0.2", "representations.ego.scale=12.0"
    options += ("representations.ego.rate_hz=6.0",)  # a step takes half of 1/6 s
    noise = "noise=depth_camera", "noise.depth_dropout=0.2"
    film, seen = film_of("representations=[ego,obj,depth]", *options, *noise), []
    frames, _ = film.drive({"episode_seed": 3}, lambda tensordict: seen.append(tensordict.clone()))
    maps, read = frames[9].maps, seen[9]
    torch.testing.assert_close(maps["obj"], read["obj"][0] * 5.0)
    torch.testing.assert_close(maps["ego"], read["ego"][0] / 24.0)
    torch.testing.assert_close(maps["depth"], (read["depth"][0] * 100.0).where(
        read["depth"][0] < 1, torch.tensor(torch.inf)
    ))  # fmt: skip
    holes = read["sensor", "noisy_depth"][0].isnan()
    assert holes.float().mean() > 0.1
    assert (maps["depth"][holes] == 0).all()
    assert film.framed == ["ego", "obj", "depth"]


@pytest.mark.slow
def test_filming_does_not_change_what_the_agent_estimates(film_of):
    """The maps beside them must not change how they are estimated."""
    pytest.importorskip("cv2", reason="flow is estimated by OpenCV")
    overrides = "representations=[raw]", "flow=estimated_fast"
    film, seen = film_of(*overrides), []
    film.drive({"episode_seed": 3}, lambda tensordict: seen.append(tensordict["raw"].clone()))
    env = film.agent.make_env(num_envs=1, num_workers=0)
    tensordict = env.reset(options={"episodes": [{"episode_seed": 3}]})
    for filmed in seen[:6]:
        assert torch.equal(tensordict["raw"], filmed)
        tensordict = env.step(leave_the_road(tensordict))["next"]
    env.close()


def test_the_picture_is_as_large_as_a_tile_unless_it_is_read(film_of):
    for name, size in (("seg", (200, 240)), ("rgb", (40, 48))):  # maps of 40 x 48, five times
        film = film_of(f"representations=[{name}]")
        assert film.env.observation_spec["sensor", "rgb"].shape == (1, 3, *size)


def test_the_last_picture_shows_the_outcome_in_its_colour(film_of):
    film = film_of("representations=[seg]")
    frames, episode = film.drive({"episode_seed": 3})
    pictures = list(film.pictures(frames, episode))
    assert len(pictures) == episode.length + 12  # the last frame for a second
    assert all((picture == pictures[-1]).all() for picture in pictures[-12:])
    colour = [*bytes.fromhex(OUTCOME_COLOURS["out_of_bounds"][1:])]
    has_it = [(picture == colour).all(axis=-1).any() for picture in pictures]
    assert has_it == [False] * (len(pictures) - 12) + [True] * 12


def test_each_frame_of_a_stack_has_a_tile(film_of):
    film = film_of("representations=[depth2,seg2]", "representations.seg2.encoding=onehot")
    frames, _ = film.drive({"episode_seed": 3})
    assert film.framed == ["depth2, 1 of 2", "depth2, 2 of 2", "seg2, 1 of 2", "seg2, 2 of 2"]
    before, now = frames[4].maps, frames[5].maps
    for name in ("depth", "seg"):  # oldest first; the newest is the exact one here
        torch.testing.assert_close(now[f"{name}2, 1 of 2"], before[name])
        torch.testing.assert_close(now[f"{name}2, 2 of 2"], now[name])


class Nearness(Depth):
    """A representation of a user's own, of two channels."""

    def compute(self, depth):
        near = 1 / depth.clamp(min=1.0)
        return (torch.cat([near, near.square()], dim=-3),)

    def output_specs(self, depth):
        shape = *depth.shape[:-3], 2, *depth.shape[-2:]
        return (Bounded(0.0, 1.0, shape=shape, device=depth.device, dtype=torch.float32),)


def test_a_representation_of_a_user_is_drawn_in_grey(film_of):
    own = {"near": {"_target_": f"{__name__}.Nearness", "range_m": 50.0}}
    film = film_of(representations=own)
    frames, _ = film.drive({"episode_seed": 3})
    assert film.framed == ["near, 1 of 2", "near, 2 of 2"]
    drawn = [film.tiles[name].draw(frames[5].maps[name]) for name in film.framed]
    near = 1 / frames[5].maps["depth"][0].clamp(min=1.0).numpy()
    for image, shares in zip(drawn, (near, near**2)):
        assert np.abs(image[..., 0] - 255 * shares)[near > 0.011].max() <= 0.51


@pytest.mark.slow
def test_a_recorded_episode_is_a_whole_film(tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    path, scene = tmp_path / "episode.mp4", composed("debug=smoke").scene
    agent = Agent.load("random", scene=scene, device="cpu")
    episode = record_episode(agent, path, episode_seed=3, frame_rate_hz=6.0)
    assert episode.fps == 6.0
    played = imageio.imread(path, plugin="FFMPEG")
    assert len(played) == episode.length + 6
    assert [file.name for file in tmp_path.iterdir()] == ["episode.mp4"]
