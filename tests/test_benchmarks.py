"""The benchmarks measure what they say, and run to their end."""

import numpy as np
import pytest

from flowrep.envs.sensing import Sensing
from flowrep.simulator.camera import depth_from_zbuffer
from tests.config.composing import composed
from tests.running import ROOT, run_python


def test_pybullets_picture_is_timed_with_everyone_in_place(monkeypatch):
    from benchmarks.frames import in_size, view_times

    scene, look = in_size("straight_road", 48), Sensing.look
    seen = []

    def watched(sensing, episode):
        picture = look(sensing, episode)
        depth = depth_from_zbuffer(picture.zbuffer, scene.camera.near_m, scene.camera.far_m)
        seen.append((depth, Sensing(sensing._street, ("depth", "instance"), "auto", 1), episode))
        return picture

    monkeypatch.setattr(Sensing, "look", watched)
    for _ in view_times(scene, 3):
        depth, drawn, episode = seen[-1]
        maps = drawn.observe(episode)
        people = maps["instance"][0] > 0
        assert people.any()
        # Without them the road or the houses behind would be seen, many metres away.
        np.testing.assert_allclose(depth[people], maps["depth"][0][people], rtol=0.02)


def test_the_variants_of_a_training_differ_in_the_threads_of_its_updates():
    from benchmarks.training import variants

    assert [composed(threads).threads for _, threads, _ in variants(4)] == [1, 4, 1, 4]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "rows"),
    [
        # a view, a frame, and each number of workers
        ("frames.py --scenes straight_road --sizes 40 --num-envs 2 --views 2 --steps 1 --rounds 1 "
         "--workers 0 1", 4),
        # two encoders in one precision or two, plain PyTorch, TorchRL's own
        ("update.py --sizes tiny --rounds 1 --threads 1", 4),
    ],
)  # fmt: skip
def test_a_benchmark_prints_its_tables(arguments, rows):
    script, *options = arguments.split()
    result = run_python(ROOT / "benchmarks" / script, *options)
    assert result.returncode == 0, result.stderr
    tables = [line for line in result.stdout.splitlines() if line.startswith("| ")]
    heads = sum(set(line) <= set("| -") for line in tables)
    assert len(tables) - 2 * heads >= rows
