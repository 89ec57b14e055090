"""docs/adding_a_representation.md: a transform and a YAML file outside of a clone are enough."""

import importlib
import re
import sys

import pytest
import torch

from flowrep.baselines import BaselinePolicy
from flowrep.config.usage import UsageError
from flowrep.experiment import build
from flowrep.experiment.agents import Agent
from flowrep.experiment.film import Film
from flowrep.experiment.run import RunFolder
from flowrep.geometry import ego_flow
from tests.config.composing import composed, config_of
from tests.running import ROOT, run_here

PAGE = ROOT / "docs" / "adding_a_representation.md"
TYPED = "+representations.contact._target_=mine.TimeToContact"


def block(language):
    (first, *_) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    return first


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The page's module, on the path, and its folder of configs."""
    (tmp_path / "mine.py").write_text(block("python"), encoding="utf-8")
    (tmp_path / "my_configs" / "representations").mkdir(parents=True)
    (tmp_path / "my_configs" / "representations" / "contact.yaml").write_text(block("yaml"))
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("mine", None)


@pytest.fixture
def config(folder):
    search = f"hydra.searchpath=[file://{folder / 'my_configs'}]"
    return composed(search, "representations=[ego,contact]", "debug=smoke", "device=cpu")


def test_a_wall_two_steps_ahead_is_in_contact_in_two_steps_wherever_it_is_seen(folder):
    K = torch.tensor([[40.0, 0, 2.3], [0, 50, 1.2], [0, 0, 1]])
    ahead = torch.eye(4)
    ahead[2, 3] = 3.0  # the camera drives 3 m a step at a wall that is 6 m ahead now
    raw = ego_flow(torch.full((1, 3, 5), 6.0), K, ahead).flow
    (contact,) = importlib.import_module("mine").TimeToContact(K, steps=1.0).compute(raw)
    torch.testing.assert_close(contact, torch.full((1, 3, 5), 0.5))


def test_an_agent_acts_on_a_users_map_and_a_film_shows_it(config):
    env = build.env(config)
    agent = build.agent(config, env)
    maps = env.reset()
    assert agent.policy(maps)["action"].shape == (4,)
    assert [codec.key for codec in agent.codecs] == ["ego", "contact"]
    assert "raw" not in maps  # which it reads, and nobody asked for
    env.close()
    film = Film(Agent(BaselinePolicy("never_turn"), config))
    assert "contact" in film.framed
    film.close()


def test_a_film_leaves_out_a_map_that_is_no_picture_of_the_camera_s_shape(config):
    upright = {"_target_": "torchrl.envs.PermuteTransform", "dims": [-3, -1, -2]}
    own = {"ego": {"scale": 1.0}, "upright": {**upright, "in_keys": [("sensor", "depth")]}}
    config = config.model_copy(update={"representations": own})
    film = Film(Agent(BaselinePolicy("never_turn"), config))
    assert film.framed == ["ego"]
    film.close()


def test_options_reach_a_users_map_which_checks_them(config):
    def contact(**options):
        own = {"contact": {"_target_": "mine.TimeToContact", **options}}
        env = build.env(config.model_copy(update={"representations": own}), seed=0)
        maps = env.rollout(1)["next", "contact"]
        env.close()
        return maps

    assert torch.equal(contact(steps=0.0), torch.zeros(4, 1, 1, 40, 48))
    assert 0 < contact(steps=1.0).amax() < contact().amax()
    with pytest.raises(UsageError, match=r"representations\.contact.*stepps"):
        contact(stepps=1.0)
    with pytest.raises(UsageError, match=r"mine\.Contact"):
        contact(_target_="mine.Contact")
    no_transform = {"e": {"_target_": "flowrep.agent.PPO"}}
    with pytest.raises(UsageError, match="Transform"):
        build.env(config.model_copy(update={"representations": no_transform}))


def test_a_trusted_map_keeps_its_options_and_takes_no_others(config, folder):
    run = RunFolder(folder / "run")
    run.write_config(config.plain())
    target = TYPED.partition("=")[2]
    assert run.config(target).representations == config.representations  # one without a list
    typed = ["run=x", TYPED, "+representations.contact.steps=1.0"]
    with pytest.raises(UsageError, match="representations="):
        config_of("evaluate", *typed)


def test_a_stored_representation_of_flowreps_names_no_code(config, folder):
    run = RunFolder(folder / "run")
    own = {"depth": {"range_m": 100.0, "missing": 0.0, "_target_": "mine.TimeToContact"}}
    run.write_config(config.plain() | {"representations": own})
    with pytest.raises(UsageError, match=re.escape("depth._target_=mine.TimeToContact")):
        run.config()
    with pytest.raises(UsageError, match="depth"):  # and no other class takes its name
        build.env(run.config(["mine.TimeToContact"]))


@pytest.mark.slow
def test_from_the_command_line(folder, monkeypatch):
    monkeypatch.chdir(folder)
    line = "python -m flowrep.train --config-dir my_configs representations=[ego,contact]"
    line += " representations.contact.steps=5 debug=smoke device=cpu hydra.run.dir=run"
    line += " total_frames=64 scene.time_limit_steps=20 evaluation.speeds=[low]"
    assert run_here(monkeypatch, [*line.split(), TYPED.lstrip("+"), "evaluation.baselines=[]"]) == 0
    line = "python -m flowrep.evaluate run=run episodes=1 speed=low baselines=[] num_workers=0"
    assert run_here(monkeypatch, [*line.split(), "device=cpu", "num_envs=1", TYPED]) == 0
