"""A typo ends in one readable line that lists what exists, with exit code 2 and no traceback."""

import os
import subprocess
import sys

import pytest

from flowrep.command_line import UsageError, check_overrides

pytest.importorskip("pybullet", reason="the commands need the simulator")


@pytest.mark.parametrize(
    ("override", "names"),
    [
        ("representations=[eggo]", ["unknown representations 'eggo'", "'ego'", "depth2", "seg"]),
        ("representations=[ego,eggo],[raw]", ["unknown representations 'eggo'"]),
        ("sed=3", ["unknown key 'sed'", "did you mean 'seed'", "total_frames", "preset"]),
        ("scene=straight", ["unknown scene 'straight'", "straight_road"]),
        ("preset=desktop", ["unknown preset 'desktop'", "laptop, paper"]),
        ("algorithm=dqm", ["unknown algorithm 'dqm'", "dsac"]),
        ("representations.ego.scal=2", ["unknown key 'scal' of 'representations.ego'", "'scale'"]),
        ("scene.camera.heigth_px=84", ["unknown key 'heigth_px' of 'scene.camera'", "height_px"]),
        ("seed.value=3", ["unknown key 'value' of 'seed'", "it has no keys"]),
        ("representations=[ego", ["can't read 'representations=[ego'"]),
    ],
)
def test_a_mistake_is_named_and_what_exists_is_listed(override, names):
    with pytest.raises(UsageError) as caught:
        check_overrides("train", [override])
    message = str(caught.value)
    assert "\n" not in message
    for name in names:
        assert name in message


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["representations=[ego,obj,seg2]", "scene=straight_road", "preset=laptop", "seed=1"],
        ["representations=[ego],[raw],[ego,obj]", "seed=0,1,2"],
        ["representations.ego.scale=0.5", "scene.camera.height_px=64", "debug=smoke"],
        ["hydra.run.dir=elsewhere", "algorithm.encoder=separate"],
    ],
)
def test_what_is_right_passes(overrides):
    check_overrides("train", overrides)


def run_command(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["flowrep.train", "representations=[eggo]"], "unknown representations 'eggo'"),
        (
            ["flowrep.train", "speed=fast", "debug=smoke"],
            "speed should be low, normal or high, not 'fast'",
        ),
        (
            ["flowrep.train", "evaluation.baselines=[never]"],
            "evaluation.baselines should be a list of different values",
        ),
        (["flowrep.train", "resume=nowhere"], "'nowhere' holds no run"),
        (["flowrep.evaluate", "run=nowhere"], "'nowhere' holds no run"),
    ],
    ids=["typo", "value", "baseline", "resume", "evaluate"],
)
def test_the_commands_end_with_one_line_and_code_2(arguments, says, tmp_path):
    result = run_command(*arguments, cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert result.stderr.startswith("error: ")
    assert says in result.stderr
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("command", ["train", "view"])
def test_a_scene_of_ones_own_that_cannot_be_ends_in_one_line(command, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "half.yaml").write_text("name: half\nframe_rate_hz: 12.0\n")
    arguments = ["--config-dir", str(tmp_path), "scene=half", f"hydra.run.dir={tmp_path / 'run'}"]
    command = [sys.executable, "-m", f"flowrep.{command}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    expected = "scene 'half': time_limit_steps: missing key; add it, a whole number"
    assert done.stderr == f"error: {expected}\n"
