"""The README's Python runs as it stands."""

import re
from pathlib import Path

import pytest
from torchrl.envs import EnvBase

from tests.transforms.fake_env import FakeSensorEnv

README = Path(__file__).parents[1] / "README.md"


def test_the_readmes_python_runs_with_the_readers_own_env():
    pytest.importorskip("pybullet", reason="the README's last example is the simulated street")
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 3
    namespace = {"my_env": FakeSensorEnv((2,))}
    exec(blocks[0], namespace)
    assert namespace["rollout"]["obj"].shape[-3] == 2
    assert set(namespace["rollout"].keys()) >= {"ego", "obj"}
    exec(blocks[1], namespace)
    assert namespace["valid"].all()
    exec(blocks[2], namespace)
    env = namespace["env"]
    assert isinstance(env, EnvBase)
    assert env.reset()["obj"].shape == (4, 2, 84, 84)
    env.close()


def test_the_readme_names_every_representation():
    from flowrep.transforms import REPRESENTATIONS

    text = README.read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in REPRESENTATIONS)


def test_every_picture_of_the_readme_is_there_and_small():
    text = README.read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text) + re.findall(r'<img src="([^"]+)"', text)
    scenes = [path.stem for path in (README.parent / "conf" / "scene").glob("*.yaml")]
    assert {
        f"docs/images/{kind}_{scene}.png" for kind in ("gallery", "plan") for scene in scenes
    } <= {*pictures}
    for picture in pictures:
        assert (README.parent / picture).stat().st_size < 300_000, picture


def test_make_gallery_makes_a_picture_of_every_scene():
    makefile = (README.parent / "Makefile").read_text(encoding="utf-8")
    (listed,) = re.findall(r"^SCENES = (.+)$", makefile, re.MULTILINE)
    scenes = {path.stem for path in (README.parent / "conf" / "scene").glob("*.yaml")}
    assert set(listed.split()) == scenes
