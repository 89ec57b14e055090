"""A mistake ends in `error:` lines and code 2; odd names pass through shell and Hydra unharmed."""

import random
import re
import shlex
import shutil
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import flowrep
from flowrep.config import CONF_DIR, cli, run_names
from tests.config.composing import SCHEMAS, schema_of

MISTAKES = [
    # a choice that doesn't exist, or is none
    ("train representations=[eggo]", ["eggo", "ego, depth"]),
    ("train scene=strait_road", ["strait_road", "straight_road, h_shaped", "--config-dir"]),
    ("train -m representations=[ego],[raw,eggo]", ["eggo", "depth2"]),
    ("train scene=my/x.yaml", ["my/x", "--config-dir", "s_turn"]),
    ("train scene=null", ["group"]),
    ("train +flow=[[[]]]", ["+flow=[[[]]]"]),
    ("train debug=[null]", ["debug=[null]"]),
    ("factorize input=x output=y", ["format", "tum", "vkitti2"]),
    # a key that doesn't exist
    ("train sed=3", ["sed"]),
    ("train ~sed", ["sed"]),
    ("train scene.camera.heigth_px=84", ["scene.camera.heigth_px"]),
    # nothing where something is needed
    ("train representations=[]", ["representations"]),
    ("train ~algorithm", ["preset"]),
    ("train total_frames=???", ["total_frames"]),
    ("report", ["run"]),
    ("factorize format=tum", ["input"]),
    # what Hydra can't read, or a shell has split
    ("train 'representations=[ego,' 'obj]'", ["representations=[ego,"]),
    ("train outputs", ["outputs"]),
    ("train seed=0,1", ["seed=0,1"]),
    ("report x run=y", ["x", "run="]),
    # what would be done in part, without a word
    ("train representations=[ego,obj,ego]", ["representations=[ego,obj,ego]", "twice"]),
    ("train experiment=recipe", ["seed, representations", "-m"]),
    ("train -m seed=3,4,3", ["s3", "twice"]),
    ("train -m seed=3 threads=1,2", ["s3", "threads"]),
    # places that don't exist, flags that contradict each other
    ("train --config-dir nowhere", ["nowhere"]),
    ("train --config-name nope", ["nope"]),
    ("train -m --cfg job", ["--multirun", "--cfg"]),
    # values
    (
        "train algorithm.gamma=2 evaluation.episodes=0 seed=x",
        ["error: algorithm.gamma:", "error: evaluation.episodes:", "error: seed:"],
    ),
    (f"train seed=1{'0' * 5000}", ["digits"]),
    (f"train algorithm.gamma=1{'0' * 400}", ["algorithm.gamma"]),
    ("train -m seed=0 hydra/launcher=ray_jobs", ["hydra_ray_launcher"]),
]


@pytest.mark.slow_after_first
@pytest.mark.parametrize(("line", "names"), MISTAKES, ids=[line for line, _ in MISTAKES])
def test_a_mistake_ends_in_lines_that_name_it_and_what_exists(run, line, names):
    command, *arguments = shlex.split(line)
    code, found, said = run(command, *arguments)
    assert code == 2
    assert not found
    lines = said.err.splitlines()
    assert lines
    assert all(line.startswith("error: ") for line in lines)
    for name in names:
        assert name in said.err


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    "line",
    [
        "train +note=me@home ++seed=4 +mine.deep=1 +algorithm@beside=dqn +hydra.job.env_set.A=1",
        "train representations.ego.scale=0.5 scene.camera.height_px=64 debug=smoke",
        "train hydra/job_logging=default hydra/hydra_logging=none ~debug",
        "train --config-path pkg://flowrep.conf",
        "train hydra/launcher=slurm hydra.launcher.partition=gpu",
        "evaluate outputs/a outputs/b speed=low fps=6 policy=sampled baselines=[]",
        "view scene=s_turn",
    ],
)
def test_the_syntax_of_hydras_command_line_is_accepted(run, line):
    if "slurm" in line:
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    command, *arguments = line.split()
    code, (config,), said = run(command, *arguments)
    assert (code, said.err) == (0, "")
    assert isinstance(config, schema_of(command))
    if "+note" in line:
        assert config.plain()["note"] == "me@home"


def test_errors_of_the_command_are_lines_too_unless_they_are_bugs(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for error, code in (
        (OSError("no space"), 2),
        (MemoryError(), 2),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 2),
        (BrokenProcessPool("A worker process was unexpectedly terminated"), 2),
        (RuntimeError("a bug"), 1),
    ):
        monkeypatch.setattr(sys, "argv", ["flowrep-train"])

        def fails(config, error=error):
            raise error

        with pytest.raises(SystemExit) as ended:
            cli.run_command("train", fails, schema_of("train"))
        assert ended.value.code == code
        assert ("Traceback" in capsys.readouterr().err) is (code == 1)


@pytest.mark.parametrize("command", SCHEMAS)
def test_help_says_what_a_command_does_and_explains_its_keys(run, command):
    code, _, said = run(command, "--help")
    assert code == 0
    assert re.match(rf"# [A-Z].*\.\n# python -m flowrep\.{command} ", said.out)
    assert re.search(r"^\w+: .+ # ", said.out, re.MULTILINE)
    assert "laptop_long" in said.out
    assert not any(word in said.out for word in ("_self_", "override hydra", "run_folder"))


def test_a_command_knows_its_version(run):
    assert run("train", "--version")[2].out == f"flowrep {flowrep.__version__}\n"


@pytest.mark.parametrize("form", ["hydra.searchpath=[pkg://mypkg]", "--config-dir"])
def test_configs_of_ones_own_are_found(run, form, tmp_path, monkeypatch):
    """By a package on the path or by a folder; what they misspell is refused."""
    folder = tmp_path / "mypkg"
    for group in ("algorithm", "experiment"):
        (folder / group).mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "algorithm" / "mine.yaml").write_text("defaults: [dqn, _self_]\nfinal_epsilon: 0.1\n")
    (folder / "experiment" / "mine.yaml").write_text("# @package _global_\ntotl_frames: 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    arguments = [form, str(folder)] if form.startswith("--") else [form]
    _, (config,), _ = run("train", *arguments, "algorithm=mine")
    assert config.algorithm.final_epsilon == 0.1
    for wrong, names in (("algorithm=mein", "mine"), ("experiment=mine", "totl_frames")):
        code, _, said = run("train", *arguments, wrong)
        assert code == 2
        assert names in said.err


SLIPS = {"a tab": ("seed: 1\n\tspeed: low\n", 2), "a key twice": ("seed: 1\nseed: 2\n", 2)}


@pytest.mark.slow_after_first
@pytest.mark.parametrize("slip", SLIPS)
@pytest.mark.parametrize("group", ["scene", "representations", ""])
def test_a_mistake_in_a_users_file_is_named_with_file_and_line(run, tmp_path, group, slip):
    text, number = SLIPS[slip]
    file = tmp_path / "conf" / group / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    choice = {"": "--config-name=mine", "representations": "representations=[mine]"}
    line = choice.get(group, f"{group}=mine")
    code, found, said = run("train", "--config-dir", str(tmp_path / "conf"), line)
    assert (code, found) == (2, [])
    (line,) = said.err.splitlines()
    assert line.startswith("error: ")
    assert f'"{file}", line {number}' in line


def test_a_scene_file_in_which_another_name_stands_is_refused(run, tmp_path):
    (tmp_path / "scene").mkdir()
    original = (CONF_DIR / "scene" / "s_turn.yaml").read_text()
    mine = tmp_path / "scene" / "back_alley.yaml"
    mine.write_text(original.replace("name: s_turn", "name: alley", 1))
    line = ["--config-dir", str(tmp_path), "scene=back_alley"]
    code, _, said = run("train", *line)
    assert code == 2
    assert "scene.name=back_alley" in said.err
    assert run("train", *line, "scene.name=back_alley")[0] == 0
    mine.write_text(original.replace("name: s_turn", "name: back_alley", 1))
    assert run("train", *line)[0] == 0


def test_a_file_that_hydra_finds_in_conf_first_is_named(run, tmp_path):
    (tmp_path / "scene").mkdir()
    original = (CONF_DIR / "scene" / "s_turn.yaml").read_text()
    mine = tmp_path / "scene" / "s_turn.yaml"
    mine.write_text(original)
    assert run("train", "--config-dir", str(tmp_path))[0] == 0
    mine.write_text(original + "# mine\n")
    for line in (["--config-dir", str(tmp_path)], [f"hydra.searchpath=[file://{tmp_path}]"]):
        assert run("train", *line)[0] == 0  # in another scene
        code, found, said = run("train", *line, "scene=s_turn")
        assert (code, found) == (2, [])
        assert f"error: {mine}" in said.err


def test_a_config_dir_may_hold_files_of_other_projects_or_a_copy_of_conf(run, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "train.yaml").write_text("lr: 3\n")
    own = (CONF_DIR / "scene" / "s_turn.yaml").read_text().replace("name: s_turn", "name: alley", 1)
    (tmp_path / "scene" / "alley.yaml").write_text(own)
    assert run("train", "--config-dir", str(tmp_path), "scene=alley")[0] == 0
    whole = tmp_path / "conf"
    shutil.copytree(CONF_DIR, whole)
    with (whole / "scene" / "s_turn.yaml").open("a") as file:
        file.write("# changed\n")
    assert run("train", f"--config-path={whole}", "scene=s_turn")[0] == 0


def test_an_installed_command_finds_modules_in_the_current_folder(run, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "path", ["/usr/bin"])
    assert run("train")[0] == 0
    assert sys.path == ["/usr/bin", str(tmp_path)]


# Names with any characters.

ODD = [
    "outputs/a", "a=b", "a,b", "[x]", "{a:b}", "it's", 'say "hi"', "both ' and \"", "a b", " a ",
    "josé (2)", "日本", "$HOME", "${x}", "\\${x}", "$${x}", "a\\", "a\\'", "\\\\'", "#a", "~a",
    "-a", "2026", "true", "null", "1e5", "a:b", "choice(a,b)", "???", "'x'", "a\nb", "%", "!x", "*",
]  # fmt: skip


def read(line):
    """Returns what a config holds after a line was typed into a shell."""
    overrides = OverridesParser.create().parse_overrides(shlex.split(line)[1:])
    config = OmegaConf.create()
    for one in overrides:
        OmegaConf.update(config, one.key_or_group, one.value())
    return OmegaConf.to_container(config, resolve=True)


def test_a_pasted_line_gives_the_very_text():
    draw = random.Random(0)
    characters = "a1=,[]{}'\"\\$ é日#%~+-:()!&;*?`|<>@^\t."
    drawn = ["".join(draw.choices(characters, k=draw.randint(1, 8))) for _ in range(100)]
    for text in ODD + drawn:
        line = shlex.join(["flowrep-train", cli.override("resume", text)])
        assert read(line) == {"resume": text}


def test_a_printed_command_has_quotes_only_where_they_are_needed(monkeypatch):
    folder = "outputs/2026-01-31/12_ego+obj_s1"
    monkeypatch.setattr(sys, "argv", ["/usr/bin/flowrep-train"])
    assert cli.line_for("evaluate", run=folder) == f"flowrep-evaluate run={folder}"


FOLDERS = [
    # with names of any characters, or like numbers
    ("run=josé (2)", "josé (2)"),
    ("run=a,b=[c]", "a,b=[c]"),  # which is there
    ("output=1e3", "1e3"),
    ("hydra.sweep.dir=/home/josé/x (2)", "/home/josé/x (2)"),
    ("hydra.run.dir=~/x", "/home/josé/x"),  # where a shell keeps the ~
    # none, or none yet
    ("run=[a,b]", ["a", "b"]),
    ("input=0", 0),  # a camera's number
    ("num_envs=2", 2),
    ("resume=null", None),
]


@pytest.mark.parametrize(("typed", "value"), FOLDERS)
def test_a_folders_name_is_taken_literally_and_other_values_are_not(
    tmp_path, monkeypatch, typed, value
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/josé")
    (tmp_path / "a,b=[c]").mkdir()
    (line,) = cli.as_typed([typed], schema_of("train"))
    assert OverridesParser.create().parse_overrides([line])[0].value() == value


def test_folders_without_a_key_are_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "it's").mkdir()
    typed = cli.as_typed(["it's", "policy=sampled", "b c"], schema_of("report"))
    assert read(shlex.join(["report", *typed])) == {"run": ["it's", "b c"], "policy": "sampled"}


def test_a_value_may_be_longer_than_a_files_name():
    typed = [f"scene.paths=[{'a,' * 3000}b]"]
    assert cli.as_typed(typed, schema_of("evaluate")) == typed


# Names of folders.


def test_run_folders_are_named_by_scene_representations_and_seed():
    def folder(*overrides):
        run_names.register_resolvers()
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            return compose("train", list(overrides), return_hydra_config=True).hydra.run.dir

    assert folder("representations=[ego,obj]", "seed=3").endswith("_straight_road_ego+obj_s3")
    assert folder("noise=depth_camera").endswith("_straight_road_ego+obj_noisy_s0")
    assert folder("resume=there") == "."  # nothing is made for a run that has a folder


@pytest.mark.parametrize(
    "name", ["../../etc", "/etc", "..", "a/b", "..\\b", "x" * 500, "ä" * 500, "\udcff", ""]
)
def test_a_name_becomes_a_visible_folder_in_the_output_folder(name):
    folder = run_names.folder_name(name)
    assert folder
    assert not folder.startswith(".")
    assert Path(folder).name == folder
    assert len(folder.encode()) <= 255


def test_names_of_a_sweeps_runs_need_no_quotes_and_stay_apart():
    odd = ["+note='a b/../c'", "representations=[ego,obj]", "~debug", "num_workers=2"]
    assert run_names.sweep_run_name(odd) == "ego+obj_note-ab_.._c__debug"
    long = ["seed=3", *(f"evaluation.some_long_key_{i}=123456" for i in range(9))]
    other = [*long[:-1], "evaluation.some_long_key_8=123457"]
    names = {run_names.sweep_run_name(long), run_names.sweep_run_name(other)}
    assert len(names) == 2
    assert all(name.startswith("s3_") and len(name) < 120 for name in names)


def test_a_mapping_of_representations_is_the_whole_stack():
    values = {"debug": "smoke", "representations": {"obj": {"scale": 0.5}}}
    config, _ = cli.composed(schema_of("train"), values)
    assert {name: of["scale"] for name, of in config.representations.items()} == {"obj": 0.5}


def test_a_config_can_be_composed_in_a_script_that_uses_hydra_itself(tmp_path):
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        config, _ = cli.composed(schema_of("train"), {"debug": "smoke"})
        assert config.total_frames > 0
        assert GlobalHydra.instance().is_initialized()
    assert not GlobalHydra.instance().is_initialized()
