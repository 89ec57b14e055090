"""The documentation: every transform has a page, what pages show runs, links lead somewhere."""

import re
from pathlib import Path

import pytest
import torch
import yaml
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import CatTensors, Compose, TransformedEnv, check_env_specs

from flowrep import transforms
from flowrep.transforms import RawFlow
from flowrep.transforms.hydra_configs import CONFIGS
from tests.transforms import oracles
from tests.transforms.fake_env import HEIGHT, WIDTH, FakeSensorEnv

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def navigation(entries):
    """Yields the pages that a navigation names, however deep."""
    for entry in entries:
        if isinstance(entry, str):
            yield entry
        else:
            for value in entry.values():
                yield from navigation([value] if isinstance(value, str) else value)


def python_of(page):
    return "\n".join(re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL))


def test_every_transform_has_its_page():
    written = "\n".join(page.read_text("utf-8") for page in (DOCS / "transforms").glob("*.md"))
    documented = set(re.findall(r"^::: flowrep\.transforms\.(\w+)", written, re.MULTILINE))
    assert documented == {
        config._target_.rsplit(".", 1)[1] for config in (make() for make in CONFIGS.values())
    }
    assert documented <= set(transforms.__all__)


def test_the_navigation_names_every_page_once():
    site = yaml.safe_load((DOCS.parent / "mkdocs.yml").read_text("utf-8"))
    named = list(navigation(site["nav"]))
    assert sorted(named) == [str(page.relative_to(DOCS)) for page in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_to_pages_and_pictures_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert missing == []


class TwoBodies(FakeSensorEnv):
    """The test's env as a simulator of its own conventions would give it."""

    def __init__(self):
        super().__init__()
        size = (1, HEIGHT, WIDTH)
        self.observation_spec = Composite(
            zbuffer=Unbounded(size),
            camera_pose=Unbounded((7,), dtype=torch.float64),
            body_poses=Unbounded((2, 7), dtype=torch.float64),
            segmentation=Unbounded(size, dtype=torch.int32),
            want=Composite(instance_motion=Unbounded((3, 4, 4)), depth=Unbounded(size), shape=()),
        )

    def _observe(self):
        sensor = super()._observe()["sensor"]
        near, far = 0.1, 100.0
        buffer = (far / (far - near)) * (1 - near / sensor["depth"])
        *position, x, y, z, w = position_and_quaternion(sensor["world_from_cam"])
        # OpenGL's y is up, its z backward: half a turn about x, the quaternion (1, 0, 0, 0), first.
        camera = torch.stack([*position, w, z, -y, -x])
        ids = torch.tensor([3, 7, 12], dtype=torch.int32)[sensor["instance"].long()]
        return TensorDict(
            zbuffer=buffer.where(sensor["depth"].isfinite() | sensor["depth"].isnan(), 1.0),
            camera_pose=camera,
            body_poses=torch.stack(
                [position_and_quaternion(body) for body in sensor["world_from_body"]]
            ),
            segmentation=ids,
            want=sensor.select("instance_motion", "depth"),
        )


def position_and_quaternion(pose):
    """Returns x, y, z and the quaternion (x, y, z, w) of a pose that is turned by less than 180."""
    m = pose[:3, :3]
    w = (1 + m.trace()).sqrt() / 2
    vector = torch.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / (4 * w)
    return torch.cat([pose[:3, 3], vector, w[None]])


def test_the_env_guide_runs_with_the_readers_own_env():
    namespace = {"my_env": TwoBodies(), "__name__": "__main__"}
    # the reader's maps are 84 x 84, the test's 7 x 5
    exec(python_of(DOCS / "use_in_your_env.md").replace(" 42.0]", " 3.0]"), namespace)
    rollout = namespace["rollout"]
    want, got = rollout["want"], rollout["sensor"]
    motions = got["instance_motion"]
    torch.testing.assert_close(motions, want["instance_motion"], atol=1e-5, rtol=0)
    torch.testing.assert_close(got["depth"], want["depth"], rtol=1e-3, atol=0, equal_nan=True)
    exact = RawFlow(namespace["K"])
    flow = exact.compute(want["depth"], got["instance"], want["instance_motion"])[0]
    torch.testing.assert_close(rollout["raw"], flow, atol=0.05, rtol=0)
    assert rollout["obj"][1:].abs().amax() > 0.5  # the walker
    assert len(namespace["stack"]) > 1
    assert namespace["valid"].all()
    assert namespace["observation"].shape == (4, 84, 84)


class IsaacLabCamera(FakeSensorEnv):
    """The test's env with a camera's buffers in the conventions of Isaac Lab."""

    def __init__(self):
        super().__init__()
        vectors, depth = Unbounded((HEIGHT, WIDTH, 2)), Unbounded((HEIGHT, WIDTH, 1))
        camera = {"depth": depth, "motion_vectors": vectors}
        camera |= {"pos_w": Unbounded(3), "quat_w_ros": Unbounded(4)}
        camera["intrinsic_matrices"] = self.observation_spec["sensor", "K"]
        self.observation_spec = Composite(camera=camera, want=self.observation_spec["sensor"])

    def _observe(self):
        sensor = super()._observe()["sensor"]
        u, v = oracles.raw(sensor)
        pose = sensor["world_from_cam"].clone()
        pose[:3, 3] -= torch.tensor([5000.0, 0.0, 0.0])  # float32 is too coarse for a wide world
        x, y, z, *vector, w = position_and_quaternion(pose).float()
        camera = {
            "depth": sensor["depth"].movedim(0, -1),
            "motion_vectors": torch.stack([-u, -v], -1),
            "pos_w": torch.stack([x, y, z]),
            "quat_w_ros": torch.stack([w, *vector]),
            "intrinsic_matrices": sensor["K"],
        }
        return TensorDict(camera=camera, want=sensor)


def test_isaac_labs_buffers_become_ego_and_object_flow():
    scope = vars(transforms) | {"CatTensors": CatTensors, "Compose": Compose}
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "simulators.md").read_text("utf-8"), re.S)
    exec(next(block for block in blocks if block.startswith("isaac_lab")), scope)
    env = TransformedEnv(IsaacLabCamera(), scope["isaac_lab"])
    check_env_specs(env, seed=None)
    for seen in env.rollout(3):
        for name in ("ego", "obj"):
            expected = getattr(oracles, name)(seen["want"])
            torch.testing.assert_close(seen[name], expected, atol=1e-3, rtol=1e-4)
    assert seen["obj"].abs().amax() > 0.3  # the walker


def test_the_data_guide_runs_and_gives_what_it_says():
    namespace = {}
    exec(python_of(DOCS / "bring_your_own_data.md"), namespace)
    # TartanAir's NED: the camera's x is forward, so 2 m along x are 2 m along OpenCV's z.
    assert namespace["prev_from_curr"][:3, 3].tolist() == [0.0, 0.0, 2.0]


def test_the_guides_own_representation_works_in_an_env():
    scope: dict = {}
    exec(python_of(DOCS / "adding_a_representation.md"), scope)
    env = TransformedEnv(FakeSensorEnv((2,)), scope["Edges"]())
    check_env_specs(env, seed=None)
    near = torch.tensor([[[2.0, 2.0, 4.0], [2.0, 4.0, torch.inf]]])
    (edges,) = scope["Edges"](factor=1.0).compute(near)
    # 1/z is .5 .5 .25 over .5 .25 0: jumps to the right 0 .25 0, .25 .25 0; below 0 .25 .25
    assert edges.tolist() == [[[0.0, 0.5, 1.0], [0.5, 1.0, 0.0]]]


def test_commands_quote_their_lists_for_every_shell():
    bare = re.compile(r"""(?<!['"\w.`(])\+?[\w./]+=\[[^\]\s]*\]""")
    for page in (*PAGES, DOCS.parent / "README.md"):
        for block in re.findall(r"```sh\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            assert not bare.search(block), f"{page.name}: {block}"
