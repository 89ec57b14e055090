"""Which renderer is taken, and what is said where numba is missing."""

import sys
import warnings

import pytest

from flowrep.simulator import camera
from flowrep.simulator.camera import choose_renderer


def without_numba(monkeypatch):
    monkeypatch.setattr(camera, "numba_is_installed", lambda: False)


@pytest.mark.parametrize(
    ("asked", "taken"),
    [("auto", "rasteriser"), ("rasteriser", "rasteriser"), ("pybullet", "pybullet")],
)
def test_the_rasteriser_is_taken_where_numba_is(asked, taken):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_renderer(asked) == taken


def test_without_numba_pybullet_draws_and_says_so_where_nobody_asked_for_it(monkeypatch):
    without_numba(monkeypatch)
    with pytest.warns(UserWarning, match="numba is not installed"):
        assert choose_renderer("auto") == "pybullet"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_renderer("pybullet") == "pybullet"


def test_without_numba_the_rasteriser_is_refused(monkeypatch):
    without_numba(monkeypatch)
    with pytest.raises(ImportError, match="needs numba"):
        choose_renderer("rasteriser")


def test_an_unknown_renderer_is_refused():
    with pytest.raises(ValueError, match=r"unknown renderer 'opengl'.* rasteriser"):
        choose_renderer("opengl")


def test_numba_is_imported_where_something_is_drawn_and_not_before(monkeypatch):
    from flowrep.envs import StreetEnv

    # None is what Python finds where a module can't be imported.
    monkeypatch.setitem(sys.modules, "flowrep.simulator.rasteriser", None)
    StreetEnv(sensors=("prev_from_curr", "frame")).close()
    StreetEnv(renderer="pybullet").close()
    with pytest.raises(ImportError):
        StreetEnv()
