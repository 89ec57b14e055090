"""PyBullet's clients: given back, and missed in one line."""

import gc
import resource
import subprocess
import sys
import textwrap
import weakref

import pybullet
import pytest

from flowrep.envs import StreetEnv


def clients():
    return sum(bool(pybullet.isConnected(physicsClientId=i)) for i in range(100))


def test_closing_twice_gives_one_client_back():
    before = clients()
    env = StreetEnv(sensors=())
    assert clients() == before + 1
    env.close()
    env.close()
    assert clients() == before


def test_a_forgotten_street_gives_its_client_back():
    before = clients()
    env = StreetEnv(sensors=())
    env.reset(seed=0)
    alive = weakref.ref(env)
    del env
    gc.collect()
    assert alive() is None
    assert clients() == before


def test_a_street_that_fails_to_build_gives_its_client_back(monkeypatch):
    before = clients()

    def fail(*args, **kwargs):
        raise RuntimeError("no body today")

    monkeypatch.setattr(pybullet, "createMultiBody", fail)
    with pytest.raises(RuntimeError, match="no body today"):
        StreetEnv(sensors=())
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
    assert said == (
        "flowrep.envs needs pybullet, which has wheels for CPython 3.10 and 3.11 only: "
        "use such a Python and run: pip install 'flowrep[sim]'"
    )
