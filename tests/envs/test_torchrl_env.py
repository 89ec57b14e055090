"""The TorchRL env: its specs, partial resets, the same episodes in one process and in two."""

import multiprocessing
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from flowrep import envs
from flowrep.envs import make_env, street_envs
from flowrep.envs.sensing import SENSORS
from flowrep.scenes.scene import CATEGORY_ID
from flowrep.transforms import Depth, FlowFactorize, RawFlow
from tests.comparing import differing

NOISE = {"depth_sigma_per_m": 0.01, "depth_dropout": 0.1, "drift_m": 0.05, "drift_rad": 0.01}


@pytest.fixture
def make(close_later):
    """Makes envs that are closed when the test ends."""
    return lambda *args, **kwargs: close_later(make_env(*args, **kwargs))


def test_flow_of_a_time_is_a_share_of_a_step_s_by_the_frame_rate(make):
    flows = []
    for rate_hz in (None, 12):
        env = make(representations={"raw": {"rate_hz": rate_hz}}, seed=3, frame_rate_hz=6.0)
        flows.append(env.step(env.reset().set("action", torch.zeros(1).long()))["next", "raw"])
    step, time = flows
    assert step.abs().max() > 1
    torch.testing.assert_close(time, step / 2)  # 1/12 s is half of 1/6 s


def actions_of(*size):
    return torch.randint(3, size, generator=torch.Generator().manual_seed(0))


def play(env, actions, start=None, begin=lambda env, acted: None):
    """Returns the steps of given actions, ended episodes begun anew."""
    tensordict, steps = env.reset() if start is None else start, []
    for action in actions:
        begin(env, tensordict.set("action", action))
        stepped, tensordict = env.step_and_maybe_reset(tensordict)
        steps.append(stepped.clone())
    return torch.stack(steps), tensordict


def test_a_reset_mask_of_false_resets_no_street_and_no_mask_resets_all(make):
    env = make("straight_road", ["ego"], num_envs=2, seed=0)
    first = env.reset()
    stepped = env.step(first.set("action", torch.tensor([1, 2])))["next"]
    none = torch.zeros(2, 1, dtype=torch.bool)
    assert torch.equal(env.reset(stepped.clone().set("_reset", none))["ego"], stepped["ego"])
    env.reset(TensorDict({"_reset": none}, env.batch_size))
    assert [street.episode.steps for street in street_envs(env)] == [1, 1]
    again = env.reset(TensorDict({}, env.batch_size))
    assert (again["episode_seed"] != first["episode_seed"]).all()
    assert not again["done"].any()
    with pytest.raises(ValueError, match="action is 7"):
        env.step(again.set("action", torch.tensor([0, 7])))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs "),
        ({"num_envs": 1.5}, "num_envs "),
        ({"num_envs": 2, "num_workers": 3}, "num_workers "),
        ({"num_envs": 2, "num_workers": -1}, "num_workers "),
        ({"num_envs": 2, "num_workers": "auto"}, "num_workers "),  # as commands have it
        *(({"seed": seed}, f"seed .*{seed}") for seed in ("x", 2.5, -1)),
        *(({"device": it}, rf"device={it} .*device=cpu$") for it in ("cuda:93", "gpu", 2.5)),
    ],
)
def test_an_invalid_argument_is_refused_by_its_name(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        make_env("straight_road", **arguments)


def test_a_transform_of_dropped_sensors_says_how_to_keep_them(make):
    env = TransformedEnv(make(representations=["seg"]), Depth())
    with pytest.raises(KeyError, match="keep_sensor=True"):
        env.reset()
    kept = TransformedEnv(make(representations=["seg"], keep_sensor=True), Depth())
    assert kept.reset()["depth"].shape == (1, 1, 84, 84)
    # what is no sensor's has another reason
    with pytest.raises(KeyError) as caught:
        TransformedEnv(make(representations=["seg"]), Depth(in_keys="metres")).reset()
    assert "keep_sensor" not in str(caught.value)


def test_maps_have_the_size_of_the_camera_of_a_scene_that_no_file_has(make, straight_road):
    camera = replace(straight_road.camera, height_px=20, width_px=30)
    env = make(replace(straight_road, camera=camera), ["seg", "ego"])
    assert env.reset()["seg"].shape == (1, 1, 20, 30)
    assert env.base_env.scene.camera == camera


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("representations", "options"),
    [
        (("ego", "obj"), {}),
        (("seg2", "rgb", "raw", "depth"), {"keep_sensor": True}),
        (("obj", "depth2"), {"noise": NOISE}),
        ((), {}),
    ],
)
def test_torchrls_own_checks_pass(make, representations, options):
    env = make(representations=representations, num_envs=2, seed=0, **options)
    check_env_specs(env)
    assert env.batch_size == (2,)


def test_the_tensordict_has_the_representations_and_no_sensor(make):
    env = make(representations=["obj", "seg"], num_envs=2, seed=0)
    reset = env.reset()
    assert set(reset.keys(True, True)) == {
        "obj", "seg", "outcome", "hit", "episode_seed", "path", "vehicle",
        "done", "terminated", "truncated",
    }  # fmt: skip
    assert reset["obj"].shape == (2, 2, 84, 84)
    assert (reset["outcome"].dtype, reset["outcome"].shape) == (torch.uint8, (2, 1))
    assert (reset["episode_seed"].dtype, reset["episode_seed"].shape) == (torch.int64, (2, 1))
    assert env.action_spec.space.n == 3


def test_only_sensors_that_a_transform_reads_are_rendered(make):
    for names, options, sensors in (
        ([], {}, ()),
        (["seg"], {}, ("semantic",)),
        (["ego"], {}, ("depth", "prev_from_curr")),
        (["ego"], {"noise": NOISE}, ("depth", "prev_from_curr", "frame")),
        (["raw"], {"noise": NOISE}, ("depth", "instance", "instance_motion")),
        (["ego"], {"keep_sensor": True}, SENSORS[:5]),  # rgb and frame are left out
    ):
        env = make(representations=names, **options)
        assert street_envs(env)[0].sensing.names == sensors


def test_compiled_reaches_the_flow_transforms(make, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: name)
    for compiled in (False, True):
        env = make(representations=["obj"], noise={"depth_dropout": 0.1}, compiled=compiled)
        flows = [t.compiled for t in env.transform if isinstance(t, RawFlow | FlowFactorize)]
        assert flows == [compiled, compiled]


def test_rendered_pictures_and_flow_estimator_have_the_same_scale(make):
    pytest.importorskip("cv2", reason="DIS is OpenCV's: pip install 'flowrep-rl[flow]'")
    for flow in ("estimated", {"source": "estimated"}, {"source": "estimated", "picture_scale": 2}):
        env = make(representations=["raw"], flow=flow, picture_scale=2, seed=0)
        assert env.reset()["raw"].shape == (1, 2, 84, 84)  # rival: that of the pictures, 168
        (street,) = street_envs(env)
        assert street.observation_space["rgb"].shape == (3, 168, 168)


@pytest.mark.slow
def test_envs_in_workers_equal_envs_in_one_process_and_take_their_states(make):
    actions = actions_of(34, 3)
    actions[:, 0] = 1  # which leads off the road within 20 steps
    arguments = {"representations": ["ego", "obj", "seg"], "num_envs": 3, "noise": NOISE}
    alone, shared = make(**arguments), make(**arguments, num_workers=2)
    check_env_specs(shared)
    for env in (alone, shared):
        env.set_seed(np.int64(7))  # numpy's numbers are numbers, too
    (steps, then), (in_workers, _) = (play(env, actions[:24]) for env in (alone, shared))
    assert steps["next", "done"].any()
    assert differing(steps, in_workers) == []
    states, then = envs.get_states(alone), then.clone()
    with pytest.raises(ValueError, match="1 states for 3 envs"):
        envs.set_states(alone, states[:1])
    expected, _ = play(alone, actions[24:], then.clone(), envs.begin_step)  # does nothing here
    shared.reset()
    envs.set_states(shared, states)
    assert envs.get_states(shared) == states
    resumed, _ = play(shared, actions[24:], then, envs.begin_step)
    assert differing(expected, resumed) == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="looks into /proc")
def test_a_worker_steps_streets_without_pytorch(make):
    """It takes some 200 MiB and most of the time that a worker needs to start."""
    others = {*multiprocessing.active_children()}
    make(representations=["ego", "obj"], num_envs=2, num_workers=1).rollout(2)
    (worker,) = {*multiprocessing.active_children()} - others
    loaded = Path(f"/proc/{worker.pid}/maps").read_text()
    assert "pybullet" in loaded
    assert "libtorch" not in loaded


def test_public_names_are_imported_on_first_use():
    for name in envs.__all__:
        assert getattr(envs, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'make_envs'"):
        _ = envs.make_envs


def test_the_mirror_of_a_scene_knows_its_flows_actions_and_camera():
    mirror = envs.make_mirror("straight_road", ["ego", "seg2"])
    mirror.images = "all"
    maps = {"ego": torch.randn(2, 84, 84), "seg2": torch.randint(5, (2, 84, 84))}
    image = mirror(TensorDict(maps | {"action": torch.tensor(1)}))
    # cx is 42.5, so that the image of column i is column 84 - i, and that of column 0 is not seen.
    turned = torch.tensor([-1.0, 1.0])[:, None, None] * maps["ego"].flip(-1)
    assert torch.equal(image["ego"][..., 1:], turned[..., :-1])
    assert torch.equal(image["seg2"][..., 1:], maps["seg2"].flip(-1)[..., :-1])
    assert image["action"] == 2
    assert envs.make_mirror("straight_road", "ego").flow_keys == ["ego"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("num_workers", [0, 2])
def test_an_env_on_cuda_equals_the_env_on_the_cpu(make, num_workers):
    actions = actions_of(40, 2)
    arguments = {"representations": ["ego", "obj", "seg2"], "num_envs": 2, "seed": 1}
    here, _ = play(make(**arguments), actions)
    env = make(**arguments, device="cuda", num_workers=num_workers)
    there, _ = play(env, actions.cuda())
    assert here["next", "done"].any()
    for key in here.keys(True, True):
        assert there[key].is_cuda
        torch.testing.assert_close(there[key].cpu(), here[key], rtol=1e-4, atol=1e-4)


def test_workers_occupy_cores_and_hide_their_streets(make, monkeypatch):
    in_workers = make(num_envs=2, num_workers=2)
    monkeypatch.setattr("flowrep.envs.torchrl_env.available_cores", lambda: 4)
    assert envs.has_spare_cores(in_workers, 2)
    assert not envs.has_spare_cores(in_workers, 3)
    assert envs.has_spare_cores(make(num_envs=2), 4)
    with pytest.raises(ValueError, match="num_workers=0"):
        street_envs(in_workers)


def test_the_order_of_episodes_does_not_depend_on_the_policy(make):
    def seeds(actions):
        env = make(representations=(), num_envs=2, seed=5)
        steps, _ = play(env, actions)
        return [steps["episode_seed"][:, i, 0].unique_consecutive()[:3].tolist() for i in (0, 1)]

    left = torch.ones(60, 2, dtype=torch.long)
    drawn = seeds(left)
    assert drawn == seeds(2 * left)
    assert drawn[0] != drawn[1]


def test_hit_is_the_class_of_what_the_vehicle_hit(make):
    env = make(representations=(), num_envs=3, seed=1)
    steps, _ = play(env, torch.zeros(200, 3, dtype=torch.long))
    outcome, hit = steps["next", "outcome"], steps["next", "hit"]
    collided = outcome == envs.Outcome.COLLISION
    assert collided.any()
    # Straight on, only people are in the way.
    assert set(hit[collided].tolist()) == {CATEGORY_ID["pedestrian"]}
    assert (hit[~collided] == 255).all()
