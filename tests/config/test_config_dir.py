"""A folder that may be somebody else's sets what its group is for, and nothing that runs."""

import pytest

from flowrep.config import CONF_DIR, cli
from flowrep.config.usage import UsageError
from tests.config.composing import schema_of

WHOLE = "# @package _global_\n"
REFUSED = {
    "a callback": ("scene", f"{WHOLE}hydra: {{callbacks: {{x: {{_target_: os.system}}}}}}"),
    "a callback by its package": ("scene", "# @package hydra.callbacks\nx: {_target_: os.system}"),
    "another section": ("scene", f"{WHOLE}algorithm: {{gamma: 0.5}}"),
    "an environment variable": ("scene", "defaults: [s_turn, _self_]\nname: ${oc.env:HOME}"),
    "a file at another place": ("scene", "defaults: [s_turn@hydra]"),
    "a file of another group": ("scene", "defaults: [{/preset: laptop}]"),
    "a launcher": ("experiment", f"{WHOLE}defaults: [{{override /hydra/launcher: joblib}}]"),
    "a folder of runs": ("preset", f"{WHOLE}hydra: {{run: {{dir: /}}}}"),
    "Hydra in runs": ("experiment", f"{WHOLE}hydra: {{sweeper: {{params: {{hydra.a: 1}}}}}}"),
    "a class in runs": ("debug", f"{WHOLE}hydra: {{sweeper: {{params: {{x._target_: a.B}}}}}}"),
    "a group of Hydra's": ("hydra/launcher", "_target_: os.system"),
    "a class": ("algorithm", "defaults: [dqn, _self_]\n_target_: mine.A"),
}  # fmt: skip

COPY = (CONF_DIR / "scene/s_turn.yaml").read_text("utf-8").replace("steps: 250", "steps: 1.5")


def written(folder, group, text):
    (folder / group).mkdir(parents=True)
    (folder / group / "mine.yaml").write_text(text)
    return f"{group}=mine"


@pytest.mark.parametrize("what", REFUSED)
def test_a_file_that_leaves_its_group_is_refused_before_anything_runs(run, tmp_path, what):
    choice = written(tmp_path, *REFUSED[what])
    group, _, name = choice.partition("=")
    for folder in (["--config-dir", str(tmp_path)], [f"hydra.searchpath=[file://{tmp_path}]"]):
        code, found, said = run("train", *folder, choice)
        assert (code, found) == (2, [])
        (line,) = said.err.splitlines()
        assert "mine" in line
    with pytest.raises(UsageError, match="mine"):
        cli.composed(schema_of("train"), {"hydra.searchpath": [f"file://{tmp_path}"], group: name})


@pytest.mark.parametrize(
    ("group", "text", "key"),
    [
        ("scene", "defaults: [s_turn, _self_]\nname: mine\ntime_limit_steps: ${.lanes}", "lanes"),
        ("scene/city", f"# @package scene\n{COPY}", "time_limit_steps"),
        ("preset", f"{WHOLE}defaults: [laptop, {{override /algorithm: dqn}}]\nseed: 7", ""),
        ("experiment", f"{WHOLE}seed: 7\nhydra: {{sweeper: {{params: {{scene: s_turn}}}}}}", ""),
    ],
)
def test_a_file_may_set_what_its_group_is_for(run, tmp_path, group, text, key):
    written(tmp_path, group, text)
    choice = "=".join(f"{group}/mine".split("/", 1))  # scene=city/mine
    flags = ["-m"] if group == "experiment" else []
    _, found, said = run("train", *flags, "--config-dir", str(tmp_path), choice)
    assert key in said.err if key else found[0].seed == 7
