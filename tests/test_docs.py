"""Pages and the files of a release agree; what pages show runs, and links lead somewhere."""

import pkgutil
import re
import shlex

import pytest
import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

import flowrep
from docs import docstrings
from flowrep import transforms
from flowrep.config.cli import as_typed
from flowrep.transforms import RawFlow
from tests.config.composing import SCHEMAS, plain, schema_of
from tests.running import ROOT, run_here
from tests.transforms.fake_env import HEIGHT, WIDTH, FakeSensorEnv

DOCS, README = ROOT / "docs", ROOT / "README.md"
PAGES = sorted(DOCS.rglob("*.md"))
OUTSIDE = ("*.md", "paper/*.md", "outputs/**/README.md", "flowrep/pretrained/*.md")
OTHERS = sorted(path for pattern in OUTSIDE for path in ROOT.glob(pattern))


def python_of(page):
    return "\n".join(re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL))


def test_every_transform_has_its_page():
    written = "\n".join(page.read_text("utf-8") for page in (DOCS / "transforms").glob("*.md"))
    documented = set(re.findall(r"^::: flowrep\.transforms\.(\w+)", written, re.MULTILINE))
    named = {name: getattr(transforms, name) for name in transforms.__all__}
    classes = {name: each for name, each in named.items() if isinstance(each, type)}
    assert documented == {name for name in classes if issubclass(classes[name], Transform)}


def test_the_names_in_the_architecture_lead_somewhere():
    text = (DOCS / "architecture.md").read_text("utf-8")
    # `flowrep.train` or `experiment.build`; not `evaluation.csv`, `config.yaml` or a path
    names = {name.removeprefix("flowrep.") for name in re.findall(r"`([\w.]+\.\w+)`", text)}
    names -= {"evaluation.csv", "config.yaml"}
    for name in names:
        pkgutil.resolve_name(f"flowrep.{name}")


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_to_pages_and_pictures_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8"))
    there = [(page.parent / link).resolve() for link in links if "://" not in link]
    assert [path for path in there if not path.exists()] == []
    if page in PAGES:  # the site has no other files
        assert [path for path in there if not path.is_relative_to(DOCS.resolve())] == []


def test_the_readmes_agents_are_those_of_the_results_and_of_the_trained_agents_card():
    rows = README.read_text("utf-8").split("| pedestrians |")[1].splitlines()[2:5]
    taught, demo = zip(*(line.split("|")[2:4] for line in rows))
    results = (ROOT / "paper" / "results.md").read_text("utf-8")
    (row,) = re.findall(r"^\|recipe 3.*\|SR\|`\[ego,obj\]`\|.*", results, re.MULTILINE)
    assert [cell.strip() for cell in taught] == row.split("|")[5:8]
    card = (ROOT / "flowrep" / "pretrained" / "README.md").read_text("utf-8")
    row, *_ = re.findall(r"^\| Straight Road \|.*", card, re.MULTILINE)
    assert [cell.split()[0] for cell in demo] == [f"{float(c):.0f}" for c in row.split("|")[2:5]]


def test_every_page_and_make_install_the_same_torch():
    pages = (README, DOCS / "getting_started.md", ROOT / "Makefile")
    asked = [re.findall(r"torch==[\d.]+", page.read_text("utf-8")) for page in pages]
    assert all(asked)
    assert len({version for versions in asked for version in versions}) == 1


def test_every_file_names_the_same_version():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    (packaged,) = re.findall(r'^version = "(.+)"$', project, re.MULTILINE)
    newest = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[0]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"]
    assert flowrep.__version__ == packaged == newest == cited


def test_pip_install_lines_name_extras_that_exist_and_read_alike():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    section = project.split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*")]
    code = [*ROOT.glob("tests/**/*.py"), *ROOT.glob("flowrep/**/*.py")]
    for path in (path for path in (*pages, *code) if path.suffix in (".md", ".py", ".ipynb")):
        text = path.read_text("utf-8")
        for quoted in re.findall(r"pip install '(?:\.|flowrep-rl)\[([\w,{}]+)\]'", text):
            assert set(quoted.split(",")) <= extras | {"{extra}"}, path
        # `flowrep` is another project's distribution
        assert not re.search(r"pip install ['\"]?flowrep(?!-rl)", text), path
        # a clone is what there is: pages and examples install `.`, with quotes for every shell
        if path in pages:
            assert not re.search(r"pip install (\.\[|\"|-e|'?flowrep)", text), path


def test_the_readmes_python_runs_with_the_readers_own_env():
    namespace = {"my_env": FakeSensorEnv((2,))}
    exec(python_of(README).replace(" 42.0]", " 3.0]"), namespace)  # the env's maps are 7 x 5
    assert namespace["rollout"]["obj"].shape[-3] == 2
    assert set(namespace["rollout"].keys()) >= {"ego", "obj"}


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
        # OpenGL's y is up, its z backward
        camera = sensor["world_from_cam"] @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
        ids = torch.tensor([3, 7, 12], dtype=torch.int32)[sensor["instance"].long()]
        return TensorDict(
            zbuffer=buffer.where(sensor["depth"].isfinite() | sensor["depth"].isnan(), 1.0),
            camera_pose=position_and_quaternion(camera),
            body_poses=torch.stack(
                [position_and_quaternion(body) for body in sensor["world_from_body"]]
            ),
            segmentation=ids,
            want=sensor.select("instance_motion", "depth"),
        )


def position_and_quaternion(pose):
    """Returns x, y, z and the quaternion (x, y, z, w) of a pose."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return torch.cat([pose[:3, 3], torch.from_numpy(turn)])


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


def test_the_data_guide_runs_and_gives_what_it_says():
    namespace = {}
    exec(python_of(DOCS / "bring_your_own_data.md"), namespace)
    # TartanAir's NED: the camera's x is forward, so 2 m along x are 2 m along OpenCV's z.
    assert namespace["prev_from_curr"][:3, 3].tolist() == [0.0, 0.0, 2.0]


@pytest.mark.slow
def test_an_agent_is_trained_evaluated_saved_and_loaded_as_the_page_of_runs_says(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    code, scope = python_of(DOCS / "runs.md"), {}
    short = 'debug="smoke", total_frames=64, evaluation={"every_frames": 0}'
    for usual, quick in (('preset="laptop"', short), ("episodes=100", "episodes=1")):
        assert usual in code
        code = code.replace(usual, quick)
    exec(code, scope)
    assert [each.speed for each in scope["episodes"]] == ["low", "normal", "high"]
    assert scope["agent"].frames == 64
    (folder,) = (tmp_path / "outputs").glob("*/*_straight_road_ego+obj_s0")
    assert (folder / "checkpoint" / "latest.safetensors").exists()


def test_commands_quote_their_lists_for_every_shell():
    bare = re.compile(r"""(?<!['"\w.`(])\+?[\w./]+=\[[^\]\s]*\]""")
    for page in (*PAGES, README):
        for block in re.findall(r"```sh\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            assert not bare.search(block), f"{page.name}: {block}"


def commands_in(page):
    """Yields the commands of a page's shell blocks, as lists of words."""
    for block in re.findall(r"```sh\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
        for line in block.replace("\\\n", "").splitlines():
            if words := shlex.split(line, comments=True):
                yield words


@pytest.mark.slow
@pytest.mark.parametrize("page", [*PAGES, README], ids=lambda page: page.stem)
def test_the_keys_and_values_of_commands_are_known(page):
    for words in commands_in(page):
        if words[:2] != ["python", "-m"] or words[2].partition(".")[2] not in SCHEMAS:
            continue
        name, typed = words[2].partition(".")[2], [word for word in words[3:] if word != "-m"]
        if "--config-dir" in typed:  # with files of the reader's own
            continue
        typed = as_typed([re.sub("[<>]", "", word) for word in typed], schema_of(name))
        chosen = []
        for override in OverridesParser.create().parse_overrides(typed):
            key = override.key_or_group
            if key.startswith("hydra") or override.is_interval_sweep():
                continue
            values = override.sweep_string_iterator() if override.is_sweep_override() else None
            chosen.append(override.input_line if values is None else f"{key}={next(values)}")
        schema_of(name).model_validate(plain(name, *chosen))


@pytest.mark.slow
def test_getting_started_works_as_it_is_pasted(tmp_path, monkeypatch):
    page = DOCS / "getting_started.md"
    monkeypatch.chdir(tmp_path)
    namespace = {}
    exec(python_of(page), namespace)
    assert namespace["rollout"]["obj"].shape == (1, 20, 2, 84, 84)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for words in commands_in(page):
        if words[0] == "make":
            assert words[1] in targets
        # tests/test_view.py drives, and one training is enough
        if words[0] != "python" or "flowrep.view" in words or "debug=smoke" in words:
            continue
        if "flowrep.evaluate" in words:
            words = [word for word in words if not word.startswith("episodes=")]
            words += ["episodes=1", "baselines=[]"]
        if "flowrep.train" in words:
            words += ["debug=smoke", "evaluation.baselines=[]", "evaluation.speeds=[normal]"]
            words += ["scene.time_limit_steps=40", "evaluation.every_frames=0", "total_frames=64"]
            words += ["evaluation.final_episodes=1", "evaluation.video=false"]
        assert run_here(monkeypatch, words) == 0, words
    made = ("outputs/first/report/index.html", "out/strip.mp4", "out/flow/obj")
    assert all((tmp_path / name).exists() for name in made)


def test_names_in_docstrings_become_links_to_the_reference():
    names = {"RawFlow": "flowrep.transforms.RawFlow", "make_env": "flowrep.envs.make_env"}
    text = "`RawFlow`, `RawFlow.compute`, `make_env()`, `other`\n```python\n>>> `RawFlow`\n```\n"
    found = docstrings.linked(text, names, own="flowrep.envs.make_env")
    targets = re.findall(r'<autoref optional identifier="([^"]+)">', found)
    assert targets == ["flowrep.transforms.RawFlow", "flowrep.transforms.RawFlow.compute"]
    assert "\n>>> `RawFlow`\n" in found
    assert docstrings.public_names().items() >= names.items()
