"""Which renderer is taken, and what is said where numba is missing."""

import sys

import pytest

from flowrep.simulator import camera
from flowrep.simulator.camera import choose_renderer


@pytest.mark.filterwarnings("error")
def test_the_rasteriser_is_taken_where_numba_is():
    for asked, taken in ("auto", "rasteriser"), ("rasteriser",) * 2, ("pybullet",) * 2:
        assert choose_renderer(asked) == taken
    with pytest.raises(ValueError, match=r"unknown renderer 'opengl'.* rasteriser"):
        choose_renderer("opengl")


@pytest.mark.filterwarnings("error")
def test_without_numba_pybullet_draws_and_says_so_where_nobody_asked_for_it(monkeypatch):
    monkeypatch.setattr(camera, "numba_is_installed", lambda: False)
    assert choose_renderer("pybullet") == "pybullet"
    with pytest.warns(UserWarning, match="numba is not installed"):
        assert choose_renderer("auto") == "pybullet"
    with pytest.raises(ImportError, match="needs numba"):
        choose_renderer("rasteriser")


def test_numba_is_imported_where_something_is_drawn_and_not_before(monkeypatch):
    from flowrep.envs import StreetEnv

    # None is what Python finds where a module can't be imported.
    monkeypatch.setitem(sys.modules, "flowrep.simulator.rasteriser", None)
    StreetEnv(sensors=("prev_from_curr", "frame")).close()
    StreetEnv(renderer="pybullet").close()
    with pytest.raises(ImportError):
        StreetEnv(picture_scale=7)  # no open env has this camera, which would be shared
