"""Every file of conf/ composes, and everything in it is used."""

import inspect
from unittest.mock import Mock

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class
from omegaconf import OmegaConf

from flowrep.config import CONF_DIR, config_groups, group_choices
from flowrep.config.cli import register_resolvers
from flowrep.config.schema import TrainConfig, validated

pytest.importorskip("pybullet", reason="composed configs are built into environments")


def composed(*overrides, name="train"):
    register_resolvers()
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        config = compose(name, list(overrides))
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=name == "train")


# Those of a training: `format` is of recordings, see tests/test_factorize.py.
GROUPS = [group for group in config_groups() if group != "format"]
GROUP_FILES = [(group, name) for group in GROUPS for name in group_choices(group)]


@pytest.mark.slow_after_first
@pytest.mark.parametrize(("group", "name"), GROUP_FILES, ids="/".join)
def test_every_choice_builds_an_env_and_an_agent_that_act(group, name):
    from flowrep.experiment import build

    choice = f"representations=[{name}]" if group == "representations" else f"{group}={name}"
    small = [] if group == "debug" else ["num_envs=1", "algorithm.batch_size=16"]
    config = validated(TrainConfig, composed(choice, *small, "device=cpu"))
    env = build.env(config)
    agent = build.agent(config, env)
    action = agent.policy(env.reset())["action"]
    env.close()
    assert action.shape == env.batch_size


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", group_choices("representations"))
def test_a_representation_is_one_key_named_as_its_file(name):
    assert list(composed(f"representations=[{name}]")["representations"]) == [name]


@pytest.mark.parametrize("name", group_choices("algorithm"))
def test_an_algorithm_spells_out_every_option_of_its_class_with_its_default(name):
    options = composed(f"algorithm={name}")["algorithm"]
    parameters = get_class(options.pop("_target_")).options()
    assert options == {name: parameter.default for name, parameter in parameters.items()}


def test_the_default_is_the_papers_table_ii():
    config = composed()
    algorithm = config["algorithm"]
    assert config["total_frames"] == 2_000_000
    assert algorithm["learning_rate"] == 3e-4
    assert algorithm["initial_alpha"] == 0.5
    assert algorithm["replay_capacity"] == 10_240
    assert algorithm["batch_size"] == 1024
    assert algorithm["hidden_size"] == 512
    assert algorithm["frames_per_update"] == 10
    assert algorithm["target_entropy_weight"] == 0.2
    camera = config["scene"]["camera"]
    assert (camera["height_px"], camera["width_px"], camera["fov_deg"]) == (84, 84, 60)


def test_a_preset_asks_of_one_algorithm_what_others_do_not_have():
    assert composed("preset=laptop")["algorithm"]["n_steps"] == 3
    assert composed("preset=paper")["algorithm"]["n_steps"] == 1
    assert "n_steps" not in composed("preset=laptop", "algorithm=ppo")["algorithm"]
    # the command line has the last word
    assert composed("preset=laptop", "algorithm.n_steps=2")["algorithm"]["n_steps"] == 2


@pytest.mark.slow
def test_the_longer_presets_change_laptop_in_the_documented_keys():
    laptop = flat(composed("preset=laptop"))
    changes = {
        "laptop_long": {
            "total_frames": 200_000,
            "checkpoint_every_frames": 50_000,
            "evaluation.every_frames": 50_000,
            "algorithm.replay_capacity": 100_000,
            "algorithm.initial_alpha": 0.3,
            "algorithm.alpha_rate_factor": 4.0,
        },
        "overnight": {
            "total_frames": 1_000_000,
            "checkpoint_every_frames": 50_000,
            "evaluation.every_frames": 100_000,
            "scene.camera.height_px": 84,
            "scene.camera.width_px": 84,
            "algorithm.frames_per_update": 32,
        },
    }
    for preset, expected in changes.items():
        config = flat(composed(f"preset={preset}"))
        assert {k: v for k, v in config.items() if v != laptop.get(k)} == expected


@pytest.mark.parametrize(
    ("cores", "device", "change", "workers"),
    [
        (1, "cpu", "renderer=auto", 0),
        (2, "cpu", "renderer=auto", 0),
        (2, "cpu", "num_workers=1", 1),
        (2, "cpu", "renderer=pybullet", 2),
        (2, "cpu", "flow=estimated", 2),
        (2, "cuda", "renderer=auto", 2),
        (3, "cpu", "renderer=auto", 3),
    ],
)
def test_workers_step_environments_where_cores_are_free(
    monkeypatch, cores, device, change, workers
):
    from flowrep.experiment import build

    pytest.importorskip("numba", reason="without it PyBullet always renders")
    made = Mock()
    monkeypatch.setattr(build, "make_env", made)
    monkeypatch.setattr(build, "available_cores", lambda: cores)
    monkeypatch.setattr(build, "device", torch.device)
    config = composed(change, "num_envs=4", "algorithm.batch_size=64", f"device={device}")
    build.env(validated(TrainConfig, config))
    assert made.call_args.kwargs["num_workers"] == workers


def flat(config, prefix=""):
    leaves = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        leaves |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return leaves


def test_a_scene_of_one_s_own_is_found_beside_the_package_s(tmp_path):
    from flowrep.experiment import build

    crossroads = CONF_DIR.parent / "tests" / "scenes" / "crossroads.yaml"
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.yaml").write_text(crossroads.read_text())
    config = composed(f"hydra.searchpath=[file://{tmp_path}]", "scene=mine", "num_envs=1")
    env = build.env(validated(TrainConfig, config), device="cpu")
    assert env.rollout(2)["ego"].shape == (1, 2, 2, 40, 60)
    env.close()


def test_flow_is_exact_unless_an_estimate_is_asked_for():
    assert composed()["flow"] == {"source": "exact"}
    estimated = composed("flow=estimated", "flow.preset=fast")["flow"]
    assert estimated == {
        "source": "estimated",
        "estimator": "dis",
        "weights": None,
        "preset": "fast",
        "min_side_px": 160,
    }


def test_sensors_are_exact_unless_noise_is_asked_for():
    assert not any(composed()["noise"].values())
    noise = composed("noise=depth_camera", "noise.drift_m=0.1")["noise"]
    assert all(noise.values())
    assert noise["drift_m"] == 0.1


def test_estimated_flow_spells_out_the_transforms_defaults():
    from flowrep.transforms import EstimatedFlow

    options = composed("flow=estimated")["flow"]
    del options["source"]
    parameters = inspect.signature(EstimatedFlow).parameters
    assert options == {name: parameters[name].default for name in options}
