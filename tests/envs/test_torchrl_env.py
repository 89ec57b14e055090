"""The TorchRL env: its specs, partial resets, the same episodes in one process and in two."""

import multiprocessing
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from flowrep import envs
from flowrep.config import CONF_DIR
from flowrep.config.yaml_file import read_yaml
from flowrep.envs import (
    Outcome,
    begin_step,
    get_states,
    has_spare_cores,
    make_env,
    make_mirror,
    set_states,
    street_envs,
)
from flowrep.envs.sensing import SENSORS
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.scene import CATEGORY_ID
from flowrep.transforms import Depth, FlowFactorize, RawFlow
from tests.comparing import differing

NOISE = {"depth_sigma_per_m": 0.01, "depth_dropout": 0.1, "drift_m": 0.05, "drift_rad": 0.01}


@pytest.fixture
def make(close_later):
    """Makes envs that are closed when the test ends."""
    return lambda *args, **kwargs: close_later(make_env(*args, **kwargs))


@pytest.fixture(scope="module")
def in_workers():
    """Two environments in a process each: starting those takes a second."""
    env = make_env(num_envs=2, num_workers=2)
    yield env
    env.close()


def test_flow_of_a_time_is_nearly_the_same_at_any_frame_rate(make):
    # People walk straight on for 1/6 s, so that flow of 1/12 s is half of a step's at 6 Hz, up to
    # perspective. At 12 Hz the second frame is the first one at 6 Hz.
    options = {"representations": {"raw": {"rate_hz": 12}}, "seed": 3}
    slow, fast = make(**options, frame_rate_hz=6.0), make(**options)
    at_slow = slow.step(slow.reset().set("action", torch.zeros(1).long()))["next", "raw"]
    td = fast.reset()
    for _ in range(2):
        td = fast.step(td.set("action", torch.zeros(1).long()))["next"]
    apart, length = (at_slow - td["raw"]).norm(dim=1), td["raw"].norm(dim=1)
    moving = length > 0.5
    assert moving.sum() > 100
    assert (apart / length)[moving].median() < 0.15


def actions_of(count, num_envs, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(3, (count, num_envs), generator=generator)


def play(env, actions, start=None):
    """Returns the steps of given actions, ended episodes begun anew."""
    tensordict, steps = env.reset() if start is None else start, []
    for action in actions:
        stepped, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
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


def test_a_scene_is_given_by_file_as_a_mapping_or_parsed(make):
    file = CONF_DIR / "scene" / "straight_road.yaml"
    scene = load_scene(file)
    assert make(file).base_env.scene == make(read_yaml(file)).base_env.scene == scene
    # One that no file has: the camera's size is what the maps have.
    small = replace(scene, camera=replace(scene.camera, height_px=20, width_px=30))
    env = make(small, ["seg", "ego"])
    assert env.reset()["seg"].shape == (1, 1, 20, 30)
    assert env.base_env.scene == small
    with pytest.raises(SceneError, match="straight_roed"):
        make("straight_roed")
    with pytest.raises(SceneError, match=r"roads"):
        make(replace(scene, roads=()))


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


def test_an_env_that_ends_is_reset_alone(make):
    env = make(representations=["seg"], num_envs=3, seed=1)
    # The first turns off the road within 20 steps; the others go straight on.
    steps, _ = play(env, torch.tensor([[1, 0, 0]]).expand(30, 3))
    first = int(steps["next", "done"][:, 0, 0].nonzero()[0])
    assert first < 20
    last, then = steps["next"][first], steps[first + 1]
    assert last["outcome"][0] == Outcome.OUT_OF_BOUNDS
    assert not steps["next", "truncated"].any()
    assert (then["episode_seed"] != last["episode_seed"])[:, 0].tolist() == [True, False, False]
    # The new episode's first picture is its own; what the others see goes on.
    alone = make(representations=["seg"], num_envs=1)
    begun = alone.reset(options={"episode_seed": int(then["episode_seed"][0])})
    assert torch.equal(begun["seg"][0], then["seg"][0])
    assert torch.equal(then["seg"][1:], last["seg"][1:])


@pytest.mark.slow
def test_envs_in_workers_equal_envs_in_one_process(make):
    actions = actions_of(24, 3)
    actions[:, 0] = 1  # which leads off the road within 20 steps
    arguments = {"representations": ["ego", "obj"], "num_envs": 3, "keep_sensor": True}
    alone, _ = play(make(**arguments, seed=7), actions)
    env = make(**arguments, seed=7, num_workers=2)
    check_env_specs(env)
    env.set_seed(np.int64(7))  # numpy's numbers are numbers, too
    shared, _ = play(env, actions)
    assert alone["next", "done"].any()
    assert differing(alone, shared) == []


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
    mirror = make_mirror("straight_road", ["ego", "seg2"])
    mirror.images = "all"
    maps = {"ego": torch.randn(2, 84, 84), "seg2": torch.randint(5, (2, 84, 84))}
    image = mirror(TensorDict(maps | {"action": torch.tensor(1)}))
    # cx is 42.5, so that the image of column i is column 84 - i, and that of column 0 is not seen.
    turned = torch.tensor([-1.0, 1.0])[:, None, None] * maps["ego"].flip(-1)
    assert torch.equal(image["ego"][..., 1:], turned[..., :-1])
    assert torch.equal(image["seg2"][..., 1:], maps["seg2"].flip(-1)[..., :-1])
    assert image["action"] == 2
    assert make_mirror("straight_road", "ego").flow_keys == ["ego"]


def test_begin_step_does_not_change_the_step(make, in_workers):
    late, early = make(num_envs=2), in_workers
    for env in (late, early):
        env.set_seed(np.int64(3))
        begin_step(env, env.reset().set("action", torch.tensor([1, 2])))
    begun = early.step(early.reset().set("action", torch.tensor([1, 2])))
    assert differing(late.step(late.reset().set("action", torch.tensor([1, 2]))), begun) == []


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


def test_workers_occupy_cores_and_hide_their_streets(make, in_workers, monkeypatch):
    monkeypatch.setattr("flowrep.envs.torchrl_env.available_cores", lambda: 4)
    assert has_spare_cores(in_workers, 2)
    assert not has_spare_cores(in_workers, 3)
    assert has_spare_cores(make(num_envs=2), 4)
    with pytest.raises(ValueError, match="num_workers=0"):
        street_envs(in_workers)


def test_states_pass_between_workers_and_one_process(make):
    actions = actions_of(30, 3, seed=3)
    make = partial(make, representations=["ego"], num_envs=3, noise=NOISE)
    alone = make(seed=0)
    _, then = play(alone, actions[:20])
    states, then = get_states(alone), then.clone()
    with pytest.raises(ValueError, match="1 states for 3 envs"):
        set_states(alone, states[:1])
    expected, _ = play(alone, actions[20:], then.clone())
    shared = make(seed=99, num_workers=2)
    shared.reset()
    set_states(shared, states)
    assert get_states(shared) == states
    resumed, _ = play(shared, actions[20:], then)
    assert differing(expected, resumed) == []


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
    collided = outcome == Outcome.COLLISION
    assert collided.any()
    # Straight on, only people are in the way.
    assert set(hit[collided].tolist()) == {CATEGORY_ID["pedestrian"]}
    assert (hit[~collided] == 255).all()
