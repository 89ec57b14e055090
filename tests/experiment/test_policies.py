"""Policies of somebody else's: what they see, and what is said of those that can't be used."""

import re

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, Unbounded

from flowrep.config.usage import UsageError
from flowrep.experiment.policies import ForeignFunction, ForeignPolicy, PolicyError, Task

TASK = Task(
    scene="straight_road",
    representations={"ego": {}, "depth": {}},
    observation_spec=Composite(ego=Unbounded((2, 4, 6)), depth=Unbounded((1, 4, 6))),
    action_spec=Categorical(3),
    intrinsics=torch.eye(3),
    device=torch.device("cpu"),
)


def maps(count=2):
    return TensorDict(
        {
            "ego": torch.zeros(count, 2, 4, 6),
            "depth": torch.arange(1.0, count + 1).reshape(-1, 1, 1, 1).expand(-1, 1, 4, 6),
            "env_id": torch.arange(count),
            "is_init": torch.ones(count, 1, dtype=torch.bool),
            "outcome": torch.zeros(count, 1),
        },
        [count],
    )


def test_actions_may_come_in_any_form():
    actions = torch.tensor([2, 0])
    of_torchrl = TensorDict({"action": actions}, [2])  # as its modules write them
    for given in ([2, 0], actions, actions.to(torch.uint8).numpy(), of_torchrl):
        action = ForeignFunction("mine", lambda maps, given=given: given, TASK)(maps())["action"]
        assert (action.dtype, action.tolist()) == (torch.int64, [2, 0])


def test_a_policy_sees_its_maps_and_nothing_of_the_env():
    seen = []
    ForeignFunction("mine", lambda maps: seen.append(maps) or [0, 0], TASK)(maps())
    assert sorted(seen[0].keys()) == ["depth", "ego", "env_id", "is_init"]
    assert seen[0].batch_size == (2,)


def test_policies_get_their_task_and_import_their_own_modules_of_one_name(tmp_path):
    for number, name in enumerate(["first", "second"]):
        (tmp_path / name).mkdir()
        (tmp_path / name / "my_model.py").write_text(f"SIDE = {number}\n")
        act = "[my_model.SIDE * len(task.representations)] * len(maps)"
        script = f"import my_model\nmake = lambda task: lambda maps: {act}"
        (tmp_path / name / "mine.py").write_text(script)
    paths = (f"{tmp_path}/{name}/mine.py:make" for name in ("first", "second", "first"))
    policies = [ForeignPolicy(path).built_for(TASK) for path in paths]
    assert [each(maps())["action"].tolist() for each in policies] == [[0, 0], [2, 2], [0, 0]]


@pytest.mark.parametrize("given", [[0.5, 0.0], [[0], [1]], [0, 3], [0, -1], None, TensorDict()])
def test_wrong_actions_of_a_policy_are_named(given):
    said = "None" if isinstance(given, TensorDict) else re.escape(str(given))
    with pytest.raises(PolicyError, match=f"^policy 'mine' returned .*{said}"):
        ForeignFunction("mine", lambda maps: given, TASK)(maps())


@pytest.mark.parametrize(
    ("body", "name", "cause"),
    [
        ("def make(task):\n    1 / 0\n", "mine.py:make", ZeroDivisionError),
        ("def make(:\n", "mine.py:make", SyntaxError),
        ("def make(task): return lambda maps: maps['rgb']\n", "mine.py:make", KeyError),
        ("def make(task): pass\n", "mine.py:mak", None),
        ("def make(task): return 3\n", "mine.py:make", None),
        ("import nowhere_at_all\n", "mine.py:make", None),
        ("", "nowhere.py:make", None),
        ("", "nowhere_at_all.part:make", None),
    ],
)
def test_an_error_in_a_policy_names_it_above_the_traceback(
    tmp_path, monkeypatch, body, name, cause
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(body)
    expected = (PolicyError, UsageError, ImportError) if cause is None else RuntimeError
    with pytest.raises(expected, match=r"mine\.py|nowhere") as caught:
        ForeignPolicy(name).built_for(TASK)(maps())
    assert cause is None or isinstance(caught.value.__cause__, cause)


def test_a_policy_that_changes_its_maps_changes_nothing_of_the_envs():
    def spoil(maps):
        maps["depth"].zero_()
        return [0, 0]

    seen = maps().apply(torch.clone)
    ForeignFunction("mine", spoil, TASK)(seen)
    assert (seen["depth"] > 0).all()
