"""An exported agent gives what the agent gives, with torch alone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from flowrep import files
from flowrep.agent import PPO, DiscreteSAC, DoubleDQN
from flowrep.agent.networks import PolicyNetwork
from flowrep.experiment.exported import ExportError, acting_program, write_agent
from flowrep.experiment.external import PolicyError, Task, check_card, load_policy
from tests.agent.plain import encode, head

HEIGHT, WIDTH, CLASSES = 40, 52, 5
SPEC = Composite(
    ego=Unbounded((1, 2, HEIGHT, WIDTH)),
    seg=Categorical(CLASSES, (1, 1, HEIGHT, WIDTH), dtype=torch.uint8),
    rgb=Bounded(0, 255, (1, 3, HEIGHT, WIDTH), dtype=torch.uint8),
    shape=(1,),
)
KEYS = ["ego", "seg", "rgb"]
CARD = {
    "maps": [{"name": key, "shape": list(SPEC[key].shape[1:]), "options": {}} for key in KEYS],
    "intrinsics": torch.eye(3).tolist(),
    "num_classes": CLASSES,
    "scene": "s_turn",
}
SMALL = {"precision": "fp32", "hidden_size": 24}


def build(algorithm):
    torch.manual_seed(3)
    options = dict(SMALL)
    if algorithm is DoubleDQN:
        options |= {"final_epsilon": 0.0, "initial_epsilon": 0.0, "layer_norm": True}
    options = algorithm.OPTIONS(**options)
    return algorithm.make_policy(SPEC, Categorical(3, (1,)), KEYS, options, total_frames=9)


def network_of(policy):
    (network,) = (module for module in policy.modules() if isinstance(module, PolicyNetwork))
    return network


def maps(count):
    generator = torch.Generator().manual_seed(count)
    ids = torch.randint(CLASSES + 1, (count, 1, HEIGHT, WIDTH), generator=generator)
    return {
        "ego": 4 * torch.randn(count, 2, HEIGHT, WIDTH, generator=generator),
        "seg": ids.where(ids < CLASSES, 255).to(torch.uint8),  # 255: no class
        "rgb": torch.randint(256, (count, 3, HEIGHT, WIDTH), generator=generator).to(torch.uint8),
    }


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A policy and the folder that it was written to."""
    policy, folder = build(DiscreteSAC), tmp_path_factory.mktemp("agent") / "new"
    write_agent(folder, acting_program(policy, SPEC), CARD)
    return policy, folder


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [DoubleDQN, PPO])
def test_every_algorithms_program_gives_the_scores_of_its_network(algorithm):
    policy = build(algorithm)
    seen = maps(3)
    with torch.no_grad():
        want = network_of(policy)(*seen.values())
    got = acting_program(policy, SPEC).module()(*seen.values())
    torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-5)
    assert all(module.training for module in policy.modules())  # as it was


@pytest.mark.slow
def test_the_loader_acts_as_the_agent_and_needs_torch_alone(exported, tmp_path):
    policy, folder = exported
    batches = [maps(1), maps(5)]
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "sys.modules.update(dict.fromkeys(['flowrep', 'tensordict', 'torchrl', 'safetensors']))\n"
        "import torch, load_agent\n"
        "act = load_agent.make()\n"
        "torch.save([act(maps) for maps in torch.load(sys.argv[2])], sys.argv[3])\n"
    )
    torch.save(batches, tmp_path / "maps.pt")
    files = [str(folder), str(tmp_path / "maps.pt"), str(tmp_path / "actions.pt")]
    result = subprocess.run([sys.executable, "-c", code, *files], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    for seen, got in zip(batches, torch.load(files[2])):
        with torch.no_grad():
            want = network_of(policy)(*seen.values()).argmax(-1)
        assert got.tolist() == want.tolist()


def test_a_program_takes_any_number_of_maps(exported):
    program = torch.export.load(exported[1] / "agent.pt2").module()
    seen = maps(5)
    whole = program(*seen.values())
    assert whole.shape == (5, 3)
    for count in (0, 1, 4):
        some = program(*(x[:count] for x in seen.values()))
        torch.testing.assert_close(some, whole[:count], atol=1e-5, rtol=1e-5)


def loaded(reference, device):
    """The function by which an exported agent acts for flowrep, on maps on the device."""
    maps_of = dict.fromkeys(KEYS)
    task = Task("s_turn", maps_of, SPEC[0], Categorical(3), torch.eye(3), torch.device(device))
    return load_policy(str(reference), task)._act


@pytest.mark.parametrize("name", ["agent.pt2", "load_agent.py:make"])
def test_an_exported_agent_acts_on_the_device_of_its_task(exported, name):
    act = loaded(exported[1] / name, "meta")  # which stands for any device but the CPU
    action = act({name: x.to("meta") for name, x in maps(3).items()})
    assert (action.device.type, action.shape) == ("meta", (3,))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", ["agent.pt2", "load_agent.py:make"])
def test_an_exported_agent_acts_on_a_gpu_as_on_the_cpu(exported, name):
    policy, folder = exported
    seen = maps(64)
    with torch.no_grad():
        scores = network_of(policy)(*seen.values())
    best, second = scores.topk(2).values.T
    clear = best - second > 0.01  # the GPU rounds differently
    assert clear.any()
    action = loaded(folder / name, "cuda")({name: x.cuda() for name, x in seen.items()})
    assert torch.equal(action.cpu()[clear], scores.argmax(-1)[clear])


def test_the_weights_are_those_of_ordinary_layers(exported):
    """Nothing of flowrep's and no program: the network of the docs, written by hand."""
    policy, folder = exported
    weights, seen = load_file(folder / "agent.safetensors"), maps(4)
    ids = (seen["seg"] == torch.arange(CLASSES)[:, None, None]).float()
    # What the maps lose where they are kept as float16, the scores may differ by.
    images = (seen["ego"].half().float(), ids, seen["rgb"].float() / 255)
    got = head(weights, "network.head", encode(weights, "network.encoder", images))
    with torch.no_grad():
        want = network_of(policy)(*seen.values())
    torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-4)


def test_a_policy_of_another_making_is_refused_by_name():
    with pytest.raises(ExportError, match="Sequential"):
        acting_program(torch.nn.Sequential(torch.nn.Linear(2, 3)), SPEC)


# Its files are of one export, and damage is noticed.


@pytest.fixture
def copied(exported, tmp_path):
    """A copy of the exported agent, whose files a test may change."""
    return Path(shutil.copytree(exported[1], tmp_path / "copy"))


def refused(folder, name):
    """What is said where the agent is used; None if it is used."""
    maps_of = {key: {} for key in KEYS}
    task = Task("s_turn", maps_of, SPEC[0], Categorical(3), torch.eye(3), torch.device("cpu"))
    try:
        check_card(f"{folder / name}", task)
        load_policy(f"{folder / name}", task)
    except PolicyError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", ["agent.pt2", "load_agent.py:make"])
@pytest.mark.parametrize("file", ["agent.pt2", "agent.json"])
def test_a_damaged_export_is_named(copied, name, file):
    assert refused(copied, name) is None
    data = (copied / file).read_bytes()
    place = data.index(b'"ego"') + 1 if file == "agent.json" else len(data) // 2
    changed = bytearray(data)
    changed[place] ^= 2
    (copied / file).write_bytes(changed)
    assert file in refused(copied, name)


@pytest.mark.parametrize("name", ["agent.pt2", "load_agent.py:make"])
def test_the_program_of_another_export_is_noticed(copied, name):
    torch.manual_seed(4)
    options = DiscreteSAC.OPTIONS(**SMALL)
    other = DiscreteSAC.make_policy(SPEC, Categorical(3, (1,)), KEYS, options, total_frames=9)
    torch.export.save(acting_program(other, SPEC), copied / "agent.pt2")
    assert "agent.pt2" in refused(copied, name)


def test_the_loader_alone_notices_a_damaged_program(copied):
    data = bytearray((copied / "agent.pt2").read_bytes())
    data[len(data) // 2] ^= 2
    (copied / "agent.pt2").write_bytes(data)
    with pytest.raises(PolicyError, match=r"agent\.pt2"):
        loaded(copied / "load_agent.py:make", "cpu")


def test_the_files_of_an_export_are_like_any_others_and_the_loader_may_be_edited(copied):
    copied.joinpath("plain").touch()
    assert {path.stat().st_mode for path in copied.iterdir()} == {
        copied.joinpath("plain").stat().st_mode
    }
    with copied.joinpath("load_agent.py").open("a") as loader:
        loader.write("# changed\n")
    assert refused(copied, "load_agent.py:make") is None


@pytest.mark.parametrize("step", ["_flush", "_rename"])
def test_an_export_that_fails_leaves_the_last_one_or_none(exported, copied, monkeypatch, step):
    policy, _ = exported
    before = {path.name: path.read_bytes() for path in copied.iterdir()}
    calls = []

    def fail(*arguments):
        calls.append(arguments)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, step, fail)
    with pytest.raises(OSError, match=f"'{copied}'"):
        write_agent(copied, acting_program(policy, SPEC), CARD | {"frames": 2})
    after = {path.name: path.read_bytes() for path in copied.iterdir()}
    assert after == (before if step == "_flush" else {})
    assert calls
