"""Where packages are missing, an import says which extra has them, and ends no interpreter."""

import importlib.util
import tomllib
from pathlib import Path
from pkgutil import resolve_name

import pytest
from hydra import compose, initialize_config_dir

import flowrep
from flowrep import extras
from flowrep.config import CONF_DIR, config_groups

PACKAGE = Path(flowrep.__file__).parent
MODULES = {
    "train.py": "training needs hydra; run: pip install 'flowrep-rl[train]'",
    "evaluate.py": "needs hydra; run: pip install 'flowrep-rl[train]'",
    "factorize.py": "needs cv2; run: pip install 'flowrep-rl[factorize]'",
    "report/__main__.py": "needs hydra; run: pip install 'flowrep-rl[report]'",
    "agent/__init__.py": "needs safetensors; run: pip install 'flowrep-rl[train]'",
    "envs/__init__.py": "needs pybullet; run: pip install 'flowrep-rl[sim]'",
    "pybullet.py": "needs pybullet; run: pip install 'flowrep-rl[sim]'",
    "scenes/__init__.py": "needs shapely; run: pip install 'flowrep-rl[sim]'",
}


def load(name, path):
    spec = importlib.util.spec_from_file_location(name, PACKAGE / path)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))


@pytest.mark.parametrize(("path", "says"), MODULES.items(), ids=list(MODULES))
def test_a_missing_package_is_named_with_the_extra_that_installs_it(path, says, monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    monkeypatch.setattr(extras.sys, "version_info", (3, 13, 0))
    with pytest.raises(ImportError) as caught:
        load("a_copy", path)
    assert says in str(caught.value)


def test_python_3_14_is_told_how_to_get_pybullet(monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    monkeypatch.setattr(extras.sys, "version_info", (3, 14, 0))
    with pytest.raises(ModuleNotFoundError) as caught:
        extras.require("flowrep.envs", "sim", "pybullet")
    assert "pip install pybullet-arm64" in str(caught.value)
    assert caught.value.name == "pybullet"  # so that pytest.importorskip skips
    with pytest.raises(ModuleNotFoundError, match="flowrep-rl"):
        extras.require("flowrep.envs", "sim", "shapely")


def test_a_command_names_a_package_that_it_needs_only_at_its_end(monkeypatch, capsys):
    monkeypatch.setattr(
        extras, "find_spec", lambda name: None if name == "imageio_ffmpeg" else name
    )
    with pytest.raises(SystemExit) as caught:
        load("__main__", "train.py")
    assert caught.value.code == 2
    assert "error: training needs imageio_ffmpeg; run: pip install" in capsys.readouterr().err


def test_every_console_script_is_there():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    for name, target in project["scripts"].items():
        assert callable(resolve_name(target))
        assert importlib.util.find_spec(f"flowrep.{name.removeprefix('flowrep-')}")


@pytest.mark.filterwarnings("error")
def test_another_project_composes_flowreps_groups(tmp_path):
    (tmp_path / "theirs.yaml").write_text(
        "defaults:\n"
        "  - representations: [ego, seg]\n"
        "  - algorithm@learner: ppo\n"
        "  - _self_\n"
        "hydra: {searchpath: ['pkg://flowrep.conf']}\n"
    )
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        config = compose("theirs", ["learner.gamma=0.9"])
    assert list(config.representations) == ["ego", "seg"]
    assert (config.learner["_target_"], config.learner.gamma) == ("flowrep.agent.PPO", 0.9)


def test_the_packages_configs_are_those_of_the_checkout():
    assert (PACKAGE / "conf").resolve() == CONF_DIR
    assert "hydra" not in config_groups()
