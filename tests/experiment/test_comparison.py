"""Every agent and every baseline is measured on the same episodes, wherever they are run."""

from functools import partial

import pytest
import torch
from rich.console import Console
from torch import nn

pytest.importorskip("pybullet", reason="policies drive the simulated street")

from flowrep.agent.networks import DiscreteActions, stochastic_policy
from flowrep.envs import make_env
from flowrep.experiment.arena import Agent, Arena
from flowrep.experiment.arena_team import ArenaTeam
from flowrep.experiment.comparison import Comparison, print_table, with_origin
from flowrep.experiment.env_pool import EnvPool
from flowrep.experiment.eye import Eye
from flowrep.experiment.run import EVALUATION_COLUMNS
from flowrep.scenes import load_scene
from tests.config.composing import composed

pytestmark = pytest.mark.slow

NO_OP = 0
NOISE = {"depth_sigma_per_m": 0.01, "depth_dropout": 0.1, "drift_m": 0.05, "drift_rad": 0.01}
ACTIONS = DiscreteActions(3, "categorical", torch.distributions.Categorical)


@pytest.fixture(scope="module")
def scene():
    small = ["scene.camera.height_px=12", "scene.camera.width_px=20"]
    return load_scene(composed(*small).scene)


class Weigher(nn.Module):
    """Logits from sums over maps, so that an action depends on what is seen."""

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, *maps: torch.Tensor) -> torch.Tensor:
        total = sum(m.float().flatten(1).sum(-1) for m in maps)
        return torch.stack([0.5 * torch.cos(self.factor * total + i) for i in range(3)], -1)


def agent(*names, factor=1.0, noise=NOISE):
    """Looks through noisy sensors: what it sees of an episode must be that of the episode alone."""
    policy = stochastic_policy(Weigher(factor), list(names), ACTIONS)
    return Agent(policy, {name: {} for name in names}, noise=noise)


def straight_on():
    def act(tensordict):
        return tensordict.set("action", torch.full(tensordict.batch_size, NO_OP))

    return Agent(act, {"depth": {}})


def one_arena(scene, agents, **where):
    return Arena(scene, agents, partial(EnvPool, **where))


def arenas(scene, agents, num_envs, num_workers):
    return ArenaTeam(scene, agents, num_envs=num_envs, num_processes=num_workers)


def rows_of(scene, agents, num_envs=3, num_workers=0, make_arena=one_arena, **asked):
    asked = {
        "speeds": ["low"],
        "fps": [12],
        "seed": 5,
        "policies": ["greedy"],
        "episodes": 4,
    } | asked
    comparison = Comparison(**asked, agents=len(agents))
    arena = make_arena(scene, agents, num_envs=num_envs, num_workers=num_workers)
    comparison.run(arena)
    arena.close()
    assert comparison.is_complete
    return [comparison.rows(number) for number in range(len(agents))]


@pytest.fixture(scope="module")
def rows(scene):
    baselines = ["never_turn", "random"]
    settings = {"speeds": ["low", "high"], "episodes": 7, "baselines": baselines}
    return rows_of(scene, [straight_on()], **settings)[0]


def of(rows, policy, speed="low"):
    columns = "episode_seed", "outcome", "hit", "return", "length"
    chosen = [row for row in rows if row["policy"] == policy and row["speed"] == speed]
    return [tuple(row[name] for name in columns) for row in chosen]


def test_an_agent_and_its_baseline_twin_live_through_the_same_episodes(rows):
    assert [row[0] for row in of(rows, "greedy")] == [5, 6, 7, 8, 9, 10, 11]
    assert of(rows, "greedy") == of(rows, "never_turn")
    assert of(rows, "greedy", "high") == of(rows, "never_turn", "high")
    assert of(rows, "greedy") != of(rows, "greedy", "high")


def test_another_policy_gets_the_same_episodes_and_ends_them_otherwise(rows):
    assert [row[0] for row in of(rows, "random")] == [row[0] for row in of(rows, "never_turn")]
    assert of(rows, "random") != of(rows, "never_turn")


def test_returns_are_the_papers_rewards(rows):
    for row in rows:
        end = 5.0 if row["outcome"] == "success" else -5.0
        assert row["return"] == pytest.approx(end + 0.01 * row["length"], abs=1e-9)


ASKED = {"fps": [12, 6], "policies": ["greedy", "sampled"], "baselines": ["random"]}


@pytest.fixture(scope="module")
def alone(scene):
    return rows_of(scene, [agent("obj", "seg2")], num_envs=1, **ASKED)[0]


def test_rows_come_in_the_order_of_what_was_asked(alone):
    order = [(row["fps"], row["policy"], row["episode_seed"]) for row in alone]
    names = "greedy", "sampled", "random"
    assert order == [(f, name, s) for f in (12.0, 6.0) for name in names for s in (5, 6, 7, 8)]
    assert len({(row["outcome"], row["length"]) for row in alone}) > 6


@pytest.mark.parametrize(
    ("make_arena", "num_envs", "num_workers"),
    [(one_arena, 3, 0), (one_arena, 5, 2), (arenas, 5, 2), (arenas, 3, 3)],
)
def test_where_episodes_are_run_is_not_seen_in_what_comes_out(
    scene, alone, make_arena, num_envs, num_workers
):
    where = num_envs, num_workers, make_arena
    assert rows_of(scene, [agent("obj", "seg2")], *where, **ASKED)[0] == alone


def test_agents_that_share_streets_do_not_touch_each_other(scene, alone):
    agents = [agent("depth2", factor=3.0, noise=None), agent("obj", "seg2")]
    other, same = rows_of(scene, agents, num_envs=4, **ASKED)
    assert same == alone
    assert [row for row in other if row["policy"] == "random"] == [
        row for row in alone if row["policy"] == "random"
    ]
    assert other != alone


def test_flow_per_second_is_that_of_each_frame_rate(scene):
    policy = stochastic_policy(Weigher(1.0), ["ego"], ACTIONS)
    per_second = Agent(policy, {"ego": {"unit": "px_per_s"}})
    both = rows_of(scene, [per_second], fps=[12, 6])[0]
    assert [row for row in both if row["fps"] == 6] == rows_of(scene, [per_second], fps=[6])[0]


def test_an_agent_drives_otherwise_with_noise(scene, alone):
    assert rows_of(scene, [agent("obj", "seg2", noise=None)], **ASKED)[0] != alone


def test_more_episodes_begin_with_those_of_fewer(scene, alone):
    more = rows_of(scene, [agent("obj", "seg2")], episodes=6, **ASKED)[0]
    assert [row for row in more if row["episode_seed"] < 9] == alone


def test_of_what_was_stopped_the_episodes_before_the_first_gap_are_kept(scene):
    comparison = Comparison(
        speeds=["low"], fps=[12], episodes=6, seed=5, policies=["greedy"], baselines=["random"]
    )
    arena = one_arena(scene, [agent("obj")], num_envs=6)
    done = []
    comparison.run(arena, lambda: done.append(1) or len(done) == 3)
    arena.close()
    assert not comparison.is_complete
    ended = {k for episodes in comparison._done.values() for k in episodes}
    assert len(ended) == 3
    gap = next(k for k in range(6) if k not in ended)
    assert [row["episode_seed"] for row in comparison.rows()] == [5 + k for k in range(gap)]


@pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noisy"])
@pytest.mark.parametrize("flow", ["exact", "estimated"])
def test_an_eye_sees_what_the_env_shows(scene, flow, noise):
    if flow == "estimated":
        pytest.importorskip("cv2")
    names = ["raw", "obj", "seg2", "depth2"]
    env = make_env(scene, names, seed=3, flow=flow, noise=noise)
    tensordict = env.reset()
    eye = Eye(scene, names, 12.0, flow=flow, noise=noise)
    pool = EnvPool(scene, eye.sensors, num_envs=2)
    order = {"episode_seed": int(tensordict["episode_seed"]), "speed": "normal"}
    for step in range(5):
        seen, _ = pool.advance([None, order])
        maps = eye.look(seen, [] if step else [1], [1] if step else [])
        for name in names:
            assert torch.equal(maps[name], tensordict[name]), (name, step)
        order = step % 3
        tensordict = env.step(tensordict.set("action", torch.tensor([order])))["next"]
    env.close()
    pool.close()


def test_an_eye_computes_where_it_is_told_to(scene):
    # the meta device stands for a GPU: it, too, refuses a K that stayed on the CPU
    eye = Eye(scene, ["raw", "ego", "obj", "seg2", "depth2"], 12.0, noise=NOISE, device="meta")
    pool = EnvPool(scene, eye.sensors, num_envs=2)
    seen, _ = pool.advance([{"episode_seed": 1}, {"episode_seed": 2}])
    first = eye.look(seen, [0, 1], [])
    seen, _ = pool.advance([0, 0])
    for maps in (first, eye.look(seen, [0], [1])):
        assert {maps[name].device.type for name in ("raw", "ego", "obj", "seg2")} == {"meta"}
    pool.close()


@pytest.mark.parametrize("flow", ["exact", "estimated"])
def test_an_eye_sees_each_street_as_if_it_were_alone(scene, flow):
    if flow == "estimated":
        pytest.importorskip("cv2")
    names = ["raw", "obj", "seg2", "depth2"]
    together, *alone = (Eye(scene, names, 12.0, flow=flow, noise=NOISE) for _ in range(3))
    pool = EnvPool(scene, together.sensors, num_envs=2)
    begins = {0: [0], 2: [1], 4: [0], 5: [1]}  # by step: the streets whose episode begins
    drives: set[int] = set()
    for step in range(7):
        begun = begins.get(step, [])
        going_on = sorted(drives.difference(begun))
        drives.update(begun)
        orders = {street: {"episode_seed": step} for street in begun} | dict.fromkeys(going_on, 0)
        seen, _ = pool.advance([orders.get(street) for street in range(2)])
        maps = together.look(seen, begun, going_on)
        for row, street in enumerate([*begun, *going_on]):
            own = [street]
            expected = alone[street].look(seen, *(([], own) if street in going_on else (own, [])))
            for name in names:
                assert torch.equal(maps[name][row], expected[name][0]), (name, step, street)
    pool.close()


def test_rows_have_the_columns_of_evaluation_csv(rows):
    config = {
        "scene": {"name": "straight_road"},
        "representations": {"ego": {}, "obj": {}},
        "flow": {"source": "exact"},
        "seed": 4,
    }
    (row, *_) = with_origin(rows, config, frames=100, evaluation="final")
    assert set(row) == set(EVALUATION_COLUMNS)
    assert row["representations"] == "ego+obj"


def test_the_table_shows_shares_with_wilson_intervals():
    rows = [
        {"speed": "low", "fps": 12.0, "policy": "greedy", "outcome": outcome}
        for outcome in ["success"] * 8 + ["collision"] * 2
    ]
    console = Console(record=True, width=100)
    print_table(rows, console)
    text = console.export_text()
    assert "80 [49–94]" in text  # Wilson's interval of 8 in 10, by hand: 0.490 to 0.943
    assert "20 [6–51]" in text
