"""A run's folder or an agent from somebody else runs no code and writes to no other file."""

import io
import sys
from contextlib import suppress

import pytest
import torch
import yaml
from safetensors.torch import save_file

from flowrep import sweep
from flowrep.agent import CheckpointError, checkpoint, load_checkpoint, save_checkpoint
from flowrep.config.usage import UsageError
from flowrep.evaluate import candidates_of
from flowrep.experiment.agents import Agent
from flowrep.experiment.run import RunFolder
from flowrep.train import resumed
from flowrep.view import agent_of
from tests.config.composing import composed, config_of, plain
from tests.experiment.test_run import episode

ALGORITHM, MAP = KEYS = "algorithm._target_", "+representations.edges._target_"
EVIL = "import pathlib; pathlib.Path(__file__).with_name('PWNED').touch()\nclass A: pass\n"


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """Makes a run whose config names a class in its folder, which can be imported."""
    monkeypatch.syspath_prepend(tmp_path)  # as the working directory is with python -m
    (tmp_path / "evil.py").write_text(EVIL)

    def make(key, target="evil.A"):
        config = plain("train", "debug=smoke", "device=cpu")
        if key == ALGORITHM:
            config["algorithm"] = {"_target_": target}
        else:
            name = key.removeprefix("+").removeprefix("representations.").removesuffix("._target_")
            config["representations"] = {name: {"_target_": target}}
        run = RunFolder(tmp_path)
        run.write_config(config)
        return run

    yield make
    for name in [name for name in sys.modules if name.partition(".")[0] == "evil"]:
        del sys.modules[name]


def resume(run, *typed):
    return resumed(composed("resume=here", *typed), run, ["resume=here", *typed])


def evaluate(run, *typed):
    return candidates_of(config_of("evaluate", f"run={run.path}", *typed))[0].load()


def view(run, *typed):
    return agent_of(config_of("view", f"policy={run.path}", *typed))


def repeated_sweep(run, *typed):
    asked = composed("debug=smoke", "device=cpu", *typed)
    return sweep.attempted(run.path, asked, io.BytesIO(), lambda: True)


def packed(run, *_):
    config = run.read_config()
    save_checkpoint(run.path / "x.safetensors", {"config": config, "frames": 1, "policy": {}})
    return Agent.load(run.path / "x.safetensors")


USES = [resume, evaluate, view, repeated_sweep, packed]


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("target", ["evil.A", "os.system", "flowrep.agent.load_checkpoint"])
def test_a_stored_run_names_no_code_whatever_else_is_typed(stranger, use, key, target):
    run = stranger(key, target)
    for typed in ([], [f"{key}=evil.B"]) if use in (resume, evaluate, view) else [[]]:
        with pytest.raises(UsageError) as refused:
            use(run, *typed)
        assert f"{key}={target}" in str(refused.value).split()  # what to type
    assert not (run.path / "PWNED").exists()
    assert "evil" not in sys.modules


@pytest.mark.parametrize("key", KEYS)
def test_a_class_that_the_user_typed_is_imported(stranger, key):
    typed, own = f"{key}=evil.A", {"_target_": "evil.A"}
    for use in (evaluate, view):
        # past the config: there is no checkpoint
        with pytest.raises(CheckpointError, match=r"latest\.safetensors"):
            use(stranger(key), typed)
    config = resume(stranger(key), typed).plain()
    # and no option or map of another
    assert own == config["algorithm"] or {"edges": own} == config["representations"]


def test_an_algorithm_typed_for_a_run_that_has_another_is_not_ignored(tmp_path):
    run = RunFolder(tmp_path)
    run.write_config(plain("train", "debug=smoke"))
    with pytest.raises(UsageError, match=r"flowrep\.agent\.DiscreteSAC"):
        resume(run, "algorithm._target_=mine.Own")


STRANGE = ["a b.C", "a.B; rm -rf x", "a.B\x1b[2J", "evil:A", "evil", "$(x).y"]


@pytest.mark.parametrize(
    ("key", "target"),
    [
        *((ALGORITHM, name) for name in STRANGE),
        *((f"+{m}._target_", "evil.A") for m in STRANGE[:3]),
    ],
)
def test_a_name_that_no_class_or_map_can_have_is_not_offered_as_an_override(stranger, key, target):
    with pytest.raises(UsageError) as refused:
        evaluate(stranger(key, target))
    assert "_target_=" not in str(refused.value)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    "algorithm", [3, "evil.A", None, [], {}, {"_target_": {"_target_": "evil.A"}}]
)
def test_an_algorithm_that_is_no_section_is_refused(tmp_path, algorithm):
    run = RunFolder(tmp_path)
    run.write_config(plain("train", "debug=smoke") | {"algorithm": algorithm})
    with pytest.raises(UsageError, match="algorithm"):
        evaluate(run)


def test_nothing_in_a_stored_config_is_resolved(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "xyzzy")
    config = plain("train", "debug=smoke") | {"note": "${oc.env:SECRET}", "experiment": "${seed}"}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    own = RunFolder(tmp_path).config().plain()
    assert (own["note"], own["experiment"]) == ("${oc.env:SECRET}", "${seed}")


# Links.


WRITES = {
    "metrics.csv": lambda run: run.log_metrics(10, {"alpha": 0.5}),
    "evaluation.csv": lambda run: run.save_episodes([episode(1)]),
    "machine.json": lambda run: run.log_machine({"cpu": "x"}),
    "config.yaml": lambda run: run.write_config({"seed": 1}),
    "checkpoint/latest.safetensors": lambda run: save_checkpoint(run.checkpoint_path, {"a": 1}),
}


@pytest.mark.parametrize("is_there", [True, False])
@pytest.mark.parametrize("name", WRITES)
def test_no_file_of_a_run_is_written_through_a_link(tmp_path, victim, name, is_there):
    run = RunFolder(tmp_path / "run")
    link = run.path / name
    link.parent.mkdir(parents=True)
    link.symlink_to(victim if is_there else victim.with_name("new"))
    with suppress(OSError, ValueError):  # refused, or the link is replaced
        WRITES[name](run)


@pytest.mark.parametrize("name", [".lock", "checkpoint", "tensorboard", "videos"])
def test_a_run_with_a_link_in_place_of_what_it_writes_does_not_begin(tmp_path, victim, name):
    run = RunFolder(tmp_path)
    (run.path / name).symlink_to(victim if name == ".lock" else victim.parent)
    with pytest.raises(OSError, match=name), run.locked():
        pass


# Checkpoints that were made to be read.

STATES = {
    "no state": {},
    "no JSON": {"state": "{", "crc32": "{}"},
    "depth": {"state": '{"dict": {"a": ' + "[" * 20_000 + "]" * 20_000 + "}}", "crc32": "{}"},
    "no such tensor": {"state": '{"dict": {"a": {"tensor": "b"}}}', "crc32": '{"a": 0}'},
    "neither": {"state": '{"dict": {"a": {"call": "os.system"}}}', "crc32": '{"a": 0}'},
    "no digests": {"state": '{"dict": {"a": 1}}', "crc32": "{}"},
}


@pytest.mark.parametrize("metadata", STATES.values(), ids=STATES)
def test_a_checkpoint_with_other_contents_is_one_error(tmp_path, metadata):
    path = tmp_path / "c.safetensors"
    about = {"format": checkpoint.FORMAT, **metadata}
    save_file({"x": torch.ones(2)}, path, metadata=about)
    with pytest.raises(CheckpointError, match=r"c\.safetensors"):
        load_checkpoint(path)
    with pytest.raises(CheckpointError, match=r"c\.safetensors"):
        load_checkpoint(path, ["a"])
