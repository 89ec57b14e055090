"""Every file of conf/ composes, and everything in it is used."""

import inspect

import pytest

from flowrep.config import config_groups, group_choices
from tests.config.composing import composed, plain

# Those of a training: `format` is of recordings, see tests/test_factorize.py.
GROUPS = [group for group in config_groups() if group != "format"]
GROUP_FILES = [(group, name) for group in GROUPS for name in group_choices(group)]


@pytest.mark.slow_after_first
@pytest.mark.usefixtures("open_streets")
@pytest.mark.parametrize(("group", "name"), GROUP_FILES)
def test_every_choice_builds_an_env_and_an_agent_that_act(group, name):
    from flowrep.experiment import build

    choice = f"representations=[{name}]" if group == "representations" else f"{group}={name}"
    small = ["algorithm.batch_size=16", "algorithm.hidden_size=16"]
    small += [] if group == "debug" else ["num_envs=1"]
    config = composed(choice, *small, "device=cpu")
    assert config.plain() == plain("train", choice, *small, "device=cpu")
    env = build.env(config)
    agent = build.agent(config, env)
    action = agent.policy(env.reset())["action"]
    env.close()
    assert action.shape == env.batch_size


@pytest.mark.parametrize("name", group_choices("algorithm"))
def test_an_algorithm_spells_out_every_option_in_its_order_with_its_default(name):
    config = composed(f"algorithm={name}").algorithm
    written = plain("train", f"algorithm={name}")["algorithm"]
    assert [*config.plain().items()] == [*written.items()]  # none is left out, and in their order
    assert config == type(config)(_target_=config.target)


def test_the_default_is_the_papers_table_ii():
    config = plain("train")
    assert config["total_frames"] == 2_000_000
    assert config["algorithm"].items() >= {
        "learning_rate": 3e-4, "initial_alpha": 0.5, "replay_capacity": 10_240, "batch_size": 1024,
        "hidden_size": 512, "frames_per_update": 10, "target_entropy_weight": 0.2,
    }.items()  # fmt: skip
    camera = config["scene"]["camera"]
    assert (camera["height_px"], camera["width_px"], camera["fov_deg"]) == (84, 84, 60)


def test_a_preset_asks_of_one_algorithm_what_others_do_not_have():
    def algorithm(*line):
        return plain("train", *line)["algorithm"]

    assert algorithm("preset=laptop")["n_steps"] == 10
    assert algorithm("preset=long") == algorithm("preset=laptop")
    assert algorithm("preset=paper")["n_steps"] == 1
    assert "n_steps" not in algorithm("preset=laptop", "algorithm=ppo")
    # the command line has the last word
    assert algorithm("preset=laptop", "algorithm.n_steps=2")["n_steps"] == 2


@pytest.mark.parametrize(("scene", "mirrors"), [("three_way_junction", True), ("s_turn", False)])
def test_laptop_presets_learn_from_images_where_a_scene_is_its_own(scene, mirrors):
    config = plain("train", "preset=laptop_long", f"scene={scene}")
    assert config["algorithm"]["mirror"] is mirrors


def test_flow_and_sensors_are_exact_unless_asked_otherwise():
    from flowrep.transforms import EstimatedFlow

    config = plain("train")
    assert config["flow"] == {"source": "exact"}
    assert not any(config["noise"].values())
    config = plain("train", "flow=estimated", "noise=depth_camera", "noise.drift_m=0.1")
    assert all(config["noise"].values())
    assert config["noise"]["drift_m"] == 0.1
    parameters = inspect.signature(EstimatedFlow).parameters
    assert config["flow"].pop("source") == "estimated"
    defaults = {name: parameters[name].default for name in config["flow"]}
    # small maps from larger pictures
    assert config["flow"] == defaults | {"picture_scale": 4, "preset": "fine"}


@pytest.mark.parametrize("name", group_choices("representations"))
def test_a_representation_spells_out_its_options_with_the_transforms_defaults(name):
    from flowrep.transforms.representations import representation_options

    given = plain("train", f"representations=[{name}]")["representations"][name]
    assert given == representation_options(name)
