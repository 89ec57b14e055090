"""PyBullet's clients: given back, and missed in one line."""

import gc
import resource
import subprocess
import sys
import textwrap
import weakref
from dataclasses import replace

import numpy as np
import pybullet
import pytest

from flowrep.envs import StreetEnv
from flowrep.simulator import street
from flowrep.simulator.bullet import Simulator
from flowrep.simulator.meshes import Mesh
from flowrep.simulator.paint import texture


@pytest.fixture
def own_scene(straight_road):
    """A scene whose simulator no street of another test shares."""
    gc.collect()  # so that no forgotten street is collected between two counts
    return replace(straight_road, name="clients")


def clients():
    return sum(bool(pybullet.isConnected(physicsClientId=i)) for i in range(100))


def test_closing_twice_gives_one_client_back(own_scene):
    before = clients()
    env = StreetEnv(own_scene, sensors=())
    assert clients() == before + 1
    env.close()
    env.close()
    assert clients() == before


def test_streets_of_one_scene_share_a_client_until_the_last_one_is_closed(own_scene):
    before = clients()
    streets = [StreetEnv(own_scene, sensors=()) for _ in range(3)]
    other = StreetEnv(replace(own_scene, name="other_clients"), sensors=())
    assert clients() == before + 2
    for env in streets[:2]:
        env.close()
        env.close()
    streets[2].reset(seed=0)
    streets[2].step(0)
    assert clients() == before + 2
    streets[2].close()
    assert clients() == before + 1
    again = StreetEnv(own_scene, sensors=())
    again.reset(seed=0)
    again.step(0)
    again.close()
    other.close()
    assert clients() == before


@pytest.mark.slow
def test_streets_that_share_a_client_keep_their_exits_and_people_apart():
    # Both stand in one world: each is asked in turn, and must not see the other's.
    paths = "south_to_north", "north_to_south"
    alone = []
    for path in paths:
        env = StreetEnv("h_shaped_pathways", renderer="pybullet")
        env.reset(options={"path": path, "episode_seed": 7})
        alone.append([env.step(i % 3)[0] for i in range(6)])
        env.close()
    envs = [StreetEnv("h_shaped_pathways", renderer="pybullet") for _ in paths]
    for env, path in zip(envs, paths):
        env.reset(options={"path": path, "episode_seed": 7})
    shared = [[env.step(i % 3)[0] for env in envs] for i in range(6)]
    for env in envs:
        env.close()
    for k in range(len(paths)):
        for i in range(6):
            for name, value in alone[k][i].items():
                np.testing.assert_array_equal(value, shared[i][k][name])


def test_ground_of_any_extent_is_a_few_bodies(make_street, monkeypatch, own_scene):
    scene = replace(own_scene, pedestrian_groups=(), building_rows=())
    sensors, views = ("depth", "semantic", "rgb"), []
    for most in (street._TRIANGLES_A_BODY, 40):
        monkeypatch.setattr(street, "_TRIANGLES_A_BODY", most)
        env = make_street(replace(scene, name=f"of_{most}"), sensors=sensors)
        views.append(env.reset(seed=0)[0])
        bodies = env._street.bodies
        assert all(len(body.triangles) <= most for body in bodies)
    assert len(bodies) > 2  # which road and sidewalk would be
    for name, value in views[0].items():
        np.testing.assert_array_equal(views[1][name], value)


def test_pybullet_takes_as_large_a_body_as_ground_is_cut_into():
    mesh, count = Mesh(), 2 * street._TRIANGLES_A_BODY + 1
    mesh.vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] * count
    mesh.normals, mesh.uvs = [[0.0, 0.0, 1.0]] * 3 * count, [[0.5, 0.5]] * 3 * count
    mesh.indices = list(range(3 * count))
    simulator = Simulator(texture())
    with pytest.raises(SystemError):
        simulator.add_body(mesh, "road")
    parts = list(mesh.parts(street._TRIANGLES_A_BODY))
    assert [len(part.indices) for part in parts] == [131_070, 131_070, 3]
    assert [simulator.add_body(part, "road") for part in parts] == [0, 1, 2]
    simulator.close()


def test_a_forgotten_street_gives_its_client_back(own_scene):
    before = clients()
    env = StreetEnv(own_scene, sensors=())
    env.reset(seed=0)
    alive = weakref.ref(env)
    del env
    gc.collect()
    assert alive() is None
    assert clients() == before


def test_a_street_that_fails_to_build_gives_its_client_back(monkeypatch, own_scene):
    before = clients()

    def fail(*args, **kwargs):
        raise RuntimeError("no body today")

    monkeypatch.setattr(pybullet, "createMultiBody", fail)
    with pytest.raises(RuntimeError, match="no body today"):
        StreetEnv(own_scene, sensors=())
    gc.collect()
    assert clients() == before


def test_memory_stays_flat_over_resets():
    env = StreetEnv()
    env.reset(seed=0)

    def some(count):
        for _ in range(count):
            env.reset()
            env.step(0)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    first = some(50)
    grown_kib = some(150) - first
    env.close()
    assert grown_kib < 4096


@pytest.mark.slow
def test_memory_stays_flat_over_streets():
    def some(count):
        for _ in range(count):
            StreetEnv(sensors=()).close()
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    first = some(5)
    # PyBullet keeps what it is given: without care that is 1.3 MB a street.
    assert some(15) - first < 8 * 1024


def test_without_pybullet_one_line_says_what_to_do():
    script = """
        import sys
        for missing in ("pybullet", "gymnasium", "shapely", "yaml"):
            sys.modules[missing] = None  # as where pip could install none of the extra
        try:
            import flowrep.envs
        except ImportError as error:
            print(error)
    """
    run = [sys.executable, "-c", textwrap.dedent(script)]
    said = subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()
    assert "pybullet" in said
    assert "[sim]" in said
