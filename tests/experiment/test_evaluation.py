"""One loop drives every policy through the same episodes, and tables say how they ended."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from torch import nn

from flowrep.agent.networks import stochastic_policy
from flowrep.envs import make_env
from flowrep.experiment.evaluation import PairedEvaluation, evaluate, scene_id
from flowrep.scenes import load_scene

NO_OP = 0
NOISE = {"depth_sigma_per_m": 0.01, "depth_dropout": 0.1, "drift_m": 0.05, "drift_rad": 0.01}


@pytest.fixture(scope="module")
def scene(straight_road):
    """Small pictures and short episodes: 60 steps lead into the first people."""
    camera = replace(straight_road.camera, height_px=12, width_px=20)
    return replace(straight_road, camera=camera, time_limit_steps=60)


class Weigher(nn.Module):
    """Logits from sums over maps, so that an action depends on what is seen."""

    def forward(self, *maps: torch.Tensor) -> torch.Tensor:
        total = sum(m.float().flatten(1).sum(-1) for m in maps)
        return torch.stack([0.5 * torch.cos(total + i) for i in range(3)], -1)


def weigher(*names):
    return stochastic_policy(Weigher(), list(names))


def straight_on(tensordict):
    return tensordict.set("action", torch.full(tensordict.batch_size, NO_OP))


def episodes(count, first=5, **options):
    return [{"episode_seed": first + k, "speed": "low", **options} for k in range(count)]


def outcomes(found):
    """What an episode is known by, in the order of the seeds, whatever ended first."""
    names = "episode_seed", "path", "outcome", "hit", "return", "length"
    rows = [each.row() for each in found]
    return sorted(tuple(row[name] for name in names) for row in rows)


def test_an_episode_is_that_of_the_gymnasium_env(make_street):
    env = make_env("three_way_junction", num_envs=2)
    driven = evaluate(env, straight_on, episodes(3, first=4, path="right"))
    found = {each.episode_seed: each for each in driven}
    env.close()
    street = make_street("three_way_junction", speed="low", sensors=())
    for seed, episode in found.items():
        _, info = street.reset(options={"episode_seed": seed, "path": "right"})
        positions, total = [street.episode.now.vehicle[:2]], 0.0
        while info["outcome"] == "running":
            _, reward, _, _, info = street.step(NO_OP)
            positions.append(street.episode.now.vehicle[:2])
            total += reward
        assert (episode.outcome, episode.hit) == (info["outcome"], info["hit"])
        row = episode.row()
        assert (row["path"], row["speed"], row["fps"]) == ("right", "low", 12.0)
        assert episode.length == street.episode.steps
        assert episode.return_ == pytest.approx(total, abs=1e-5)
        np.testing.assert_allclose(episode.positions, positions, atol=1e-4)
    # From the middle of the start zone, at 10 m/s and 12 steps per second, straight along x.
    np.testing.assert_allclose(
        found[4].positions[:3], [(7, 0), (7 + 10 / 12, 0), (7 + 20 / 12, 0)], atol=1e-5
    )


def test_the_policy_sees_the_busy_envs_and_which_of_them_have_just_begun(scene):
    env, seen = make_env(scene, ["depth"], num_envs=3), []

    def act(tensordict):
        seen.append((tensordict["env_id"].tolist(), tensordict["is_init"].flatten().tolist()))
        assert tensordict["depth"].shape == (len(tensordict), 1, 12, 20)
        return straight_on(tensordict)

    found = list(evaluate(env, act, episodes(4)))
    env.close()
    assert len(found) == 4
    assert seen[0] == ([0, 1, 2], [True, True, True])
    assert seen[1] == ([0, 1, 2], [False, False, False])
    assert len(seen[-1][0]) == 1  # the others are idle by then
    begun = sum(sum(is_init) for _, is_init in seen)
    assert begun == 4
    assert sum(len(ids) for ids, _ in seen) == sum(e.length for e in found)


@pytest.mark.slow
def test_an_episode_does_not_depend_on_what_else_is_in_the_batch(scene):
    names, ways = ["obj", "seg2", "depth2"], (True, False)
    runs = []
    for num_envs, num_workers in ((1, 0), (3, 0), (5, 2)):
        env = make_env(scene, names, noise=NOISE, num_envs=num_envs, num_workers=num_workers)
        driven = (evaluate(env, weigher(*names), episodes(4), greedy=greedy) for greedy in ways)
        runs.append([outcomes(found) for found in driven])
        env.close()
    assert runs[0] == runs[1] == runs[2]
    for found in runs[0]:
        assert len({(outcome, length) for _, _, outcome, _, _, length in found}) > 2


@pytest.mark.slow
def test_rows_come_in_the_order_of_what_was_asked(scene):
    asked = {"speeds": ["low", "high"], "fps": [12, 6], "episodes": 3, "seed": 5}
    names = "greedy", "sampled", "random"
    comparison = PairedEvaluation(**asked, policies=names[:2], baselines=names[2:])
    comparison.run(partial(make_env, scene, representations=["obj"]), weigher("obj"), num_envs=4)
    assert comparison.done == comparison.total == 36
    records = comparison.records(scene="s_turn", frames=7)
    assert {(each.scene, each.frames) for each in records} == {("s_turn", 7)}
    rows = [each.row() for each in records]
    order = [(row["speed"], row["fps"], row["policy"], row["episode_seed"]) for row in rows]
    assert order == [*product(("low", "high"), (12.0, 6.0), names, (5, 6, 7))]
    ends = [[row["length"] for row in rows if row["policy"] == name] for name in names[:2]]
    assert ends[0] != ends[1]  # sampled actions are not the greedy ones
    for row in rows:
        end = 5.0 if row["outcome"] == "success" else -5.0
        assert row["return"] == pytest.approx(end + 0.01 * row["length"], abs=1e-9)


def test_a_scenes_id_changes_with_any_of_its_values(scene):
    assert scene_id(scene) == scene_id(replace(scene))
    assert scene_id(scene) != scene_id(replace(scene, time_limit_steps=3))
    assert scene_id(scene) != scene_id(replace(scene, pedestrian_size=0.7))
    # As in the tables of outputs/reference/resolution.zip, which are older than pedestrian_size.
    assert scene_id(load_scene("straight_road")) == "5abf759d"
