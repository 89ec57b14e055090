import sys

import pytest

from flowrep.experiment.run_folder import RunFolder
from flowrep.experiment.weights_and_biases import run_id


def test_a_resumed_run_keeps_its_name_and_another_has_its_own(tmp_path):
    first, other = RunFolder(tmp_path / "a").path, RunFolder(tmp_path / "b").path
    assert run_id(first) == run_id(first) != run_id(other)


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    RunFolder(tmp_path).log_to_wandb("off", {})
    with pytest.raises(ImportError, match=r"wandb=offline needs .*flowrep\[train,wandb\]"):
        RunFolder(tmp_path).log_to_wandb("offline", {})


@pytest.mark.slow
def test_offline_runs_are_kept_in_the_folder_and_go_on_under_the_same_name(tmp_path):
    wandb = pytest.importorskip("wandb", reason="needs the extra: pip install 'flowrep[wandb]'")
    names = []
    for frames in (10, 20):
        run = RunFolder(tmp_path)
        run.log_to_wandb("offline", {"seed": 3})
        run.log_metrics(frames, {"alpha": 1 / frames})
        names.append(wandb.run.id)
        assert wandb.run.config["seed"] == 3
        assert dict(wandb.run.summary)["alpha"] == 1 / frames
        wandb.finish()
    assert names == [run_id(tmp_path)] * 2
    assert list((tmp_path / "wandb").glob(f"offline-run-*/run-{names[0]}.wandb"))
    assert (tmp_path / "metrics.csv").read_text().splitlines()[1:] == ["10,0.1", "20,0.05"]
