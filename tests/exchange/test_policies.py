"""Policies of somebody else's: what they see, and what is said of those that can't be used."""

import shutil
import sys
from importlib import import_module
from zipfile import ZipFile

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical, Composite, Unbounded

from flowrep.exchange import policies
from flowrep.exchange.policies import ForeignPolicy, PolicyError, Task, load_policy

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
            "street": torch.arange(count),
            "is_init": torch.ones(count, 1, dtype=torch.bool),
            "outcome": torch.zeros(count, 1),
        },
        [count],
    )


def written(tmp_path, body):
    path = tmp_path / "mine.py"
    path.write_text(body)
    return str(path)


@pytest.mark.parametrize(
    "given",
    [
        [2, 0],
        torch.tensor([2, 0]),
        torch.tensor([2, 0], dtype=torch.uint8).numpy(),
        TensorDict({"action": torch.tensor([2, 0])}, [2]),
    ],
    ids=["list", "tensor", "array", "tensordict"],
)
def test_actions_may_come_in_any_form(given):
    policy = ForeignPolicy("mine", lambda maps: given, TASK)
    action = policy(maps())["action"]
    assert action.dtype == torch.int64
    assert action.tolist() == [2, 0]


def test_a_policy_sees_its_maps_and_nothing_of_the_env():
    seen = []
    ForeignPolicy("mine", lambda maps: seen.append(maps) or [0, 0], TASK)(maps())
    assert sorted(seen[0].keys()) == ["depth", "ego", "is_init", "street"]
    assert seen[0].batch_size == (2,)


def test_a_torchrl_module_is_a_policy():
    module = TensorDictModule(lambda depth: depth[:, 0, 0, 0].long(), ["depth"], ["action"])
    assert ForeignPolicy("mine", module, TASK)(maps())["action"].tolist() == [1, 2]


def test_alone_on_a_street_only_its_first_step_is_an_initial_one():
    begun = []
    policy = ForeignPolicy("mine", lambda maps: begun.append(maps["is_init"].item()) or [1], TASK)
    for _ in range(2):  # two episodes
        act = policy.alone()
        step = maps(1).exclude("street", "is_init")
        assert sorted(act(act(step)).keys()) == ["action", "depth", "ego", "outcome"]
    assert begun == [True, False, True, False]


def test_make_is_told_the_task_and_may_import_what_lies_beside_it(tmp_path):
    (tmp_path / "my_net.py").write_text("SIDE = 1\n")
    path = written(
        tmp_path,
        "import my_net\n"
        "def make(task):\n"
        "    return lambda maps: [my_net.SIDE * len(task.representations)] * len(maps)\n",
    )
    assert load_policy(f"{path}:make", TASK)(maps(3))["action"].tolist() == [2, 2, 2]


def test_a_program_that_torch_saved_is_a_policy(tmp_path):
    class Scores(torch.nn.Module):
        def forward(self, ego, depth):
            return -(depth.mean((1, 2, 3)).unsqueeze(-1) - torch.arange(3)).abs()

    given = (torch.zeros(2, 2, 4, 6), torch.zeros(2, 1, 4, 6))
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(Scores(), given, dynamic_shapes=(batch, batch))
    torch.export.save(program, tmp_path / "agent.pt2")
    # Depths 1 and 2 are nearest to the scores of actions 1 and 2.
    assert load_policy(str(tmp_path / "agent.pt2"), TASK)(maps())["action"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([0.5, 0.0], "returned torch.float32 of shape (2,); expected 2 whole numbers from 0 to 2"),
        ([[0], [1]], "returned torch.int64 of shape (2, 1); expected 2 whole numbers"),
        ([0, 3], "returned [0, 3]; expected 2 whole numbers from 0 to 2, one action per env"),
        ([0, -1], "returned [0, -1]; expected"),
        (None, "returned a NoneType; expected"),
        (TensorDict(), "returned a NoneType; expected"),
    ],
)
def test_what_is_no_action_is_named(given, said):
    with pytest.raises(PolicyError) as caught:
        ForeignPolicy("mine", lambda maps: given, TASK)(maps())
    assert str(caught.value).startswith(f"policy 'mine' {said}")


@pytest.mark.parametrize(
    ("body", "name", "said"),
    [
        ("def make(task): pass\n", "mak", "has no function 'mak'; there are: make"),
        ("x = 3\n", "x", "has no function 'x'; there are: none"),
        ("def make(task): return 3\n", "make", "make(task) returned a int; expected a function"),
        ("def make(task):\n    1 / 0\n", "make", "failed: ZeroDivisionError: division by zero ("),
        (
            "import nowhere_at_all\n",
            "make",
            "failed: ModuleNotFoundError: No module named",
        ),
        ("def make(:\n", "make", "failed: SyntaxError: invalid syntax"),
    ],
)
def test_a_file_without_a_policy_is_named(tmp_path, body, name, said):
    path = written(tmp_path, body)
    with pytest.raises(PolicyError) as caught:
        load_policy(f"{path}:{name}", TASK)
    assert str(caught.value).startswith(f"policy '{path}:{name}'")
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_an_error_on_the_way_is_said_with_its_own_line(tmp_path):
    path = written(tmp_path, "def make(task):\n    return lambda maps: maps['rgb']\n")
    with pytest.raises(PolicyError, match=r"failed: KeyError: .*rgb.*mine\.py, line 2\)"):
        load_policy(f"{path}:make", TASK)(maps())
    path = written(tmp_path, "import json\ndef make(task):\n    return json.loads('depth')\n")
    with pytest.raises(PolicyError, match=r"failed: JSONDecodeError: .*mine\.py, line 3\)"):
        load_policy(f"{path}:make", TASK)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The module under test as a wheel has it, in the folder of libraries, with a policy beside."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    shutil.copy(policies.__file__, folder / "installed_policies.py")
    (folder / "installed_policy.py").write_text(
        "import torch\n"
        "def make(task):\n"
        "    return lambda maps: torch.zeros(2) + torch.zeros(3)\n"
        "def refuse(task):\n"
        "    raise ValueError('no depth here')\n"
    )
    monkeypatch.syspath_prepend(folder)
    yield import_module("installed_policies")
    for name in ("installed_policies", "installed_policy"):
        sys.modules.pop(name, None)


def test_an_installed_policys_error_is_said_with_the_line_that_was_called(installed):
    with pytest.raises(installed.PolicyError, match=r"no depth here \(.*policy\.py, line 5\)"):
        installed.load_policy("installed_policy:refuse", TASK)
    act = installed.load_policy("installed_policy:make", TASK)
    with pytest.raises(installed.PolicyError, match=r"must match .*policy\.py, line 3\)"):
        act(maps())


def test_a_damaged_program_is_named(installed, tmp_path):
    path = tmp_path / "agent.pt2"
    with ZipFile(path, "w") as archive:
        archive.writestr("version", "of something else")
    with pytest.raises(installed.PolicyError) as caught:
        installed.load_policy(str(path), TASK)
    assert str(caught.value).startswith(f"policy '{path}' failed: ")
    assert "installed_policies" not in str(caught.value)  # a line of flowrep's helps nobody


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("nowhere.py:make", "there is no file nowhere.py"),
        ("nowhere.pt2", "there is no such file"),
        ("no_such_package.part:make", "there is no module no_such_package; is its folder in PYTHO"),
    ],
)
def test_what_is_not_there_is_named(reference, said):
    with pytest.raises(PolicyError) as caught:
        load_policy(reference, TASK)
    assert said in str(caught.value)
