"""Which renderer is taken, and when numba is imported for it."""

import sys

import pytest

from flowrep.simulator.camera import choose_renderer


def test_the_rasteriser_is_the_default_renderer():
    for asked, taken in ("auto", "rasteriser"), ("rasteriser",) * 2, ("pybullet",) * 2:
        assert choose_renderer(asked) == taken
    with pytest.raises(ValueError, match=r"unknown renderer 'opengl'.* rasteriser"):
        choose_renderer("opengl")


def test_numba_is_imported_only_for_drawing(monkeypatch):
    from flowrep.envs import StreetEnv

    # None is what Python finds where a module can't be imported.
    monkeypatch.setitem(sys.modules, "flowrep.simulator.rasteriser", None)
    StreetEnv(sensors=("prev_from_curr", "frame")).close()
    StreetEnv(renderer="pybullet").close()
    with pytest.raises(ImportError):
        StreetEnv(picture_scale=7)  # no open env has this camera, which would be shared
