"""A typo ends in one readable line that lists what exists, with exit code 2 and no traceback."""

import os
import signal
import subprocess
import sys

import pytest
from hydra.core.global_hydra import GlobalHydra

from flowrep.config import UsageError, command_line
from flowrep.config.composition import check_command
from flowrep.config.training import TrainConfig
from flowrep.config_tree import CONF_DIR

pytest.importorskip("pybullet", reason="the commands need the simulator")

from flowrep.envs import WorkerError
from flowrep.experiment.run import RunFolder
from flowrep.train import carry_out, main

MISTAKES = [
    ("representations=[eggo]", ["unknown representations 'eggo'", "'ego'", "depth2", "seg"]),
    ("sed=3", ["unknown key 'sed'", "did you mean 'seed'", "total_frames", "preset"]),
    ("scene=straight", ["unknown scene 'straight'", "straight_road"]),
    ("representations.ego.scal=2", ["unknown key 'scal' of 'representations.ego'", "'scale'"]),
    ("representations=[ego", ["can't read 'representations=[ego'"]),
    ("hydra/launcher=joblb", ["unknown hydra/launcher 'joblb'", "'joblib'", "basic"]),
    ("-m scene=s_turn,straight", ["unknown scene 'straight'"]),
    ("seed=0,1", ["'seed=0,1' is several values: add -m", "seed=[0,1]"]),
    ("--config-dir nowhere", ["--config-dir: there is no folder", "nowhere"]),
]
# Left to the whole suite.
MORE_MISTAKES = [
    ("seed.value=3", ["unknown key 'value' of 'seed'", "it has no keys"]),
    ("scene=null", ["scene should be one of: h_shaped_pathways", "not null"]),
    ("hydra.run.dirr=x", ["Could not override 'hydra.run.dirr'"]),
    ("~algorithm", ["'algorithm' needs a value: algorithm=...", "dqn, dsac, dsac_v, ppo"]),
    ("-m seed=0,1,-2", ["seed should be a whole number from 0 to 2147483647, not -2"]),
    ("hydra.run.dir=/home/josé/x", ["'hydra.run.dir='\"'\"'/home/josé/x'\"'\"''"]),
    ("--config-name nope", ["Cannot find primary config 'nope'"]),
    ("--config-path pkg://nowhere", ["Primary config module 'nowhere' not found"]),
    ("-m representations=[ego],[raw,eggo]", ["unknown representations 'eggo'"]),
    ("preset=desktop", ["unknown preset 'desktop'", "laptop, laptop_long, overnight, paper"]),
    ("algorithm=dqm", ["unknown algorithm 'dqm'", "dsac"]),
    ("scene.camera.heigth_px=84", ["unknown key 'heigth_px' of 'scene.camera'", "height_px"]),
    ("representations=null", ["representations should be one of: depth, depth2", "not null"]),
    ("hydra/job_logging=loud", ["unknown hydra/job_logging 'loud'", "default"]),
    ("~sed", ["unknown key 'sed'", "did you mean 'seed'"]),
    ("-m algorithm.gamma=interval(0.9,1.5)", ["algorithm.gamma should be", "not 1.5"]),
    ("--cfg job sed=1", ["unknown key 'sed'"]),
    ("--help scene=straight", ["unknown scene 'straight'"]),
    ("--info config sed=1", ["unknown key 'sed'"]),
    ("-m --hydra-help seed=0,1", ["'seed=0,1' is several values: give one of them"]),
    ("hydra.mode=MULTIRUN seed=0,1 --cfg job", ["'seed=0,1' is several values: give one"]),
]


@pytest.mark.parametrize(
    ("override", "names"),
    [*MISTAKES, *(pytest.param(*mistake, marks=pytest.mark.slow) for mistake in MORE_MISTAKES)],
)
def test_a_mistake_is_named_and_what_exists_is_listed(override, names):
    with pytest.raises(UsageError) as caught:
        check_command("train", override.split(), TrainConfig)
    message = str(caught.value)
    assert "\n" not in message
    for name in names:
        assert name in message


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (
            "-m seed=0,1 --cfg job",
            "--multirun starts a sweep, --cfg shows the config of one run: keep one",
        ),
        ("-m --info defaults", "--multirun starts a sweep, --info shows"),
        ("--run -m seed=0", "--run starts a run, --multirun starts a sweep"),
        ("--cfg job --info plugins -m", "--multirun .*, --cfg .*, --info .*: keep one"),
        ("--resolve", "--resolve says how --cfg and --help show a config: add --cfg job"),
        ("--resolve --hydra-help", "add --cfg job"),
        ("--package scene", "--package says which part --cfg shows: add --cfg job"),
        ("--experimental-rerun x.pickle", "reads a pickle.* resume="),
        ("--config-path conf", "absolute path .* not 'conf'; --config-dir adds"),
        ("--shell-completion", "followed by install=SHELL, .* bash, fish, zsh for SHELL, not ''"),
        ("--shell-completion install=tcsh", "bash, fish, zsh for SHELL, not 'install=tcsh'"),
        ("-sc query=zsh", "sets COMP_LINE .*--shell-completion install=zsh prints"),
        ("--config-path /nowhere", "absolute path .* not '/nowhere'"),
    ],
)
def test_flags_that_contradict_each_other_or_do_nothing_are_refused(flags, says):
    with pytest.raises(UsageError, match=says):
        check_command("train", flags.split(), TrainConfig)


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    "line",
    [
        "",
        "representations=[ego,obj,seg2] scene=straight_road preset=laptop seed=1",
        "-m representations=[ego],[raw],[ego,obj] seed=0,1,2",
        "-m scene=glob(s*) seed=range(0,1000)",
        "representations.ego.scale=0.5 scene.camera.height_px=64 debug=smoke",
        "hydra.run.dir=elsewhere algorithm.encoder=separate",
        "-m hydra/launcher=joblib seed=0,1",
        "-m hydra/launcher=submitit_local seed=0,1",
        "-m hydra/launcher=slurm hydra.launcher.partition=gpu seed=0,1",
        "-m hydra/sweeper=optuna hydra/sweeper/sampler=random algorithm.gamma=interval(0.9,0.99)",
        "hydra/job_logging=default hydra/hydra_logging=none hydra.verbose=true",
        "+note=pilot ++seed=4 +mine.deep=1 +algorithm@beside=dqn +hydra.job.env_set.A=1",
        "~debug",
        "--cfg job seed=-1",
        "--cfg all --package hydra.run --resolve",
        "--info searchpath",
        "-m --help --resolve",
        "-m --hydra-help",
        "--shell-completion install=bash",
        "--config-path pkg://flowrep.conf",
        "-m",
    ],
)
def test_what_hydra_accepts_passes(line):
    check_command("train", line.split(), TrainConfig)


def test_the_shell_can_ask_for_completions(monkeypatch):
    monkeypatch.setenv("COMP_LINE", "flowrep-train scene=")
    check_command("train", ["--shell-completion", "query=bash"], TrainConfig)


@pytest.mark.slow
@pytest.mark.parametrize("shows", ["--help", "--info"])  # prints, logs
def test_output_that_is_no_longer_read_ends_a_command_silently(shows):
    command = [sys.executable, "-m", "flowrep.train", shows]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.communicate()[1] == b""
    assert process.returncode == -signal.SIGPIPE


@pytest.mark.parametrize("form", ["hydra.searchpath=[pkg://mypkg.conf]", "--config-dir"])
def test_configs_of_one_s_own_are_found(form, tmp_path, monkeypatch):
    """An algorithm of the user's, by a package on the path or by a folder."""
    folder = tmp_path / "mypkg" / "conf"
    (folder / "algorithm").mkdir(parents=True)
    for place in (folder.parent, folder):
        (place / "__init__.py").touch()
    dqn = (CONF_DIR / "algorithm" / "dqn.yaml").read_text()
    mine = dqn.replace("final_epsilon: 0.05", "final_epsilon: 0.1")
    (folder / "algorithm" / "mine.yaml").write_text(mine)
    monkeypatch.syspath_prepend(tmp_path)
    arguments = [form, str(folder)] if form.startswith("--") else [form]
    check_command("train", [*arguments, "algorithm=mine"], TrainConfig)
    with pytest.raises(UsageError, match=r"unknown algorithm 'mein'.*dqn, dsac, dsac_v, mine, ppo"):
        check_command("train", [*arguments, "algorithm=mein"])


def test_the_check_leaves_hydra_as_it_found_it():
    check_command("train", [])
    assert not GlobalHydra.instance().is_initialized()


def test_a_worker_that_dies_while_a_run_is_built_is_one_line(tmp_path, monkeypatch, capsys):
    def dies(config, folder):
        raise WorkerError("the worker process of environment 0 is gone (SIGKILL)")

    monkeypatch.setattr("flowrep.train.make_training", dies)
    with pytest.raises(SystemExit) as ended:
        carry_out({}, RunFolder(tmp_path))
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said == "error: the worker process of environment 0 is gone (SIGKILL)\n"


@pytest.mark.parametrize("key", ["hydra.run.dir", "hydra.sweep.dir"])
def test_an_output_folder_that_can_not_be_made_is_one_line(key, tmp_path, monkeypatch, capsys):
    (tmp_path / "taken").touch()
    flag = ["-m"] if "sweep" in key else []
    monkeypatch.setattr(sys, "argv", ["flowrep-train", *flag, f"{key}={tmp_path}/taken/run"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: the ")
    assert said.endswith(f"'{tmp_path}/taken/run'): give another with {key}=\n")
    assert said.count("\n") == 1


def test_output_that_is_closed_is_no_folder_that_can_not_be_made(monkeypatch, capsys):
    def closed():
        raise BrokenPipeError

    monkeypatch.setattr(command_line, "exit_unread", lambda: sys.exit(141))
    monkeypatch.setattr(sys, "argv", ["flowrep-train"])
    with pytest.raises(SystemExit) as ended:
        command_line.run_command("train", closed, TrainConfig)
    assert ended.value.code == 141
    assert capsys.readouterr().err == ""


def run_command(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


@pytest.mark.slow
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


def test_a_scene_file_that_kept_the_name_of_its_original_is_refused(tmp_path):
    (tmp_path / "scene").mkdir()
    original = (CONF_DIR / "scene" / "s_turn.yaml").read_text()
    (tmp_path / "scene" / "back_alley.yaml").write_text(original)
    line = ["--config-dir", str(tmp_path), "scene=back_alley"]
    expected = (
        "scene=back_alley has the name 's_turn', under which its results would be filed: write "
        "name: back_alley in its file, or add scene.name=back_alley"
    )
    for command in ("train", "evaluate"):
        with pytest.raises(UsageError) as caught:
            check_command(command, [*line, "run=here"] if command == "evaluate" else line)
        assert str(caught.value) == expected
    with pytest.raises(UsageError, match="scene=back_alley has the name 's_turn'"):
        check_command("train", [*line[:2], "-m", "scene=s_turn,back_alley"])
    check_command("train", [*line, "scene.name=back_alley"], TrainConfig)
    experiment = "# @package _global_\nscene: {name: slow_street, time_limit_steps: 100}\n"
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "slow.yaml").write_text(experiment)
    check_command("train", [*line[:2], "scene=straight_road", "experiment=slow"], TrainConfig)
    renamed = original.replace("name: s_turn", "name: back_alley", 1)
    (tmp_path / "scene" / "back_alley.yaml").write_text(renamed)
    check_command("train", line, TrainConfig)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "view"])
def test_a_scene_of_ones_own_that_cannot_be_ends_in_one_line(command, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "half.yaml").write_text("name: half\nframe_rate_hz: 12.0\n")
    arguments = ["--config-dir", str(tmp_path), "scene=half", f"hydra.run.dir={tmp_path / 'run'}"]
    command = [sys.executable, "-m", f"flowrep.{command}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    expected = "scene 'half': time_limit_steps: missing key; add it"
    assert done.stderr == f"error: {expected}\n"
