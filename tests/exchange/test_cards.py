"""An exported agent on maps other than its own is refused, with what it takes to put it right."""

import json
from dataclasses import replace

import pytest
import torch
from torchrl.data import Categorical, Composite, Unbounded

from flowrep.exchange.cards import check_card
from flowrep.exchange.policies import PolicyError, Task

# 60 degrees up and down 30 rows are 15 / tan(30) = 25.98 pixels of focal length.
K = [[25.98076, 0.0, 26.5], [0.0, 25.98076, 14.5], [0.0, 0.0, 1.0]]
OPTIONS = {"ego": {"scale": 1.0, "unit": "px_per_step"}, "seg": {"encoding": "ids"}}
CARD = {
    "maps": [
        {"name": "ego", "shape": [2, 30, 52], "options": OPTIONS["ego"]},
        {"name": "seg", "shape": [1, 30, 52], "options": OPTIONS["seg"]},
    ],
    "intrinsics": K,
    "num_classes": 5,
    "scene": "straight_road",
}


def task(names=("ego", "seg"), size=(30, 52), classes=5, **changes):
    specs = {
        "ego": Unbounded((2, *size)),
        "seg": Categorical(classes, (1, *size), dtype=torch.uint8),
        "depth": Unbounded((1, *size)),
    }
    made = Task(
        scene="straight_road",
        representations={name: OPTIONS.get(name, {}) for name in names},
        observation_spec=Composite({name: specs[name] for name in names}),
        action_spec=Categorical(3),
        intrinsics=torch.tensor(K),
        device=torch.device("cpu"),
    )
    return replace(made, **changes)


@pytest.fixture(params=["agent.pt2", "load_agent.py:make"])
def agent(request, tmp_path):
    (tmp_path / "agent.json").write_text(json.dumps(CARD))
    return f"{tmp_path}/{request.param}"


def refusal(agent, task):
    with pytest.raises(PolicyError) as caught:
        check_card(agent, task)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"policy '{agent}' was trained on other maps than those of ")
    return message.split(" than those of ")[1]


def test_an_agent_passes_on_its_own_maps(agent):
    check_card(agent, task())


SCALED = {**OPTIONS, "ego": {"scale": 0.5, "unit": "px_per_step"}}


@pytest.mark.parametrize(
    ("shown", "here", "give"),
    [
        (
            task(size=(60, 104), intrinsics=2 * torch.tensor(K)),
            "scene.camera.height_px=60 scene.camera.width_px=104",
            "scene.camera.height_px=30 scene.camera.width_px=52",
        ),
        (  # 15 pixels of focal length see 45 degrees up and 45 down
            task(intrinsics=torch.tensor([[15.0, 0, 26.5], [0, 15.0, 14.5], [0, 0, 1]])),
            "scene.camera.fov_deg=90.0",
            "scene.camera.fov_deg=60.0",
        ),
        (task(["ego"]), "representations=[ego]", "representations=[ego,seg]"),
        (task(["depth"]), "representations=[depth]", "representations=[ego,seg]"),
        (
            task(representations=SCALED),
            "representations.ego.scale=0.5",
            "representations.ego.scale=1.0",
        ),
        (task(classes=6, scene="s_turn"), "scene=s_turn", "scene=straight_road"),
    ],
    ids=["size", "view", "one too few", "others", "options", "classes"],
)
def test_other_maps_are_refused_with_the_overrides_for_its_own(agent, shown, here, give):
    assert refusal(agent, shown) == f"{here}; give {give}"


def test_the_loader_picks_its_maps_by_name_and_the_program_by_their_order(agent):
    for names in (["seg", "ego"], ["ego", "depth", "seg"]):
        if agent.endswith(".pt2"):
            said = refusal(agent, task(names))
            assert said == f"representations=[{','.join(names)}]; give representations=[ego,seg]"
        else:
            check_card(agent, task(names))


def test_policies_that_flowrep_did_not_export_are_left_alone(tmp_path):
    other = task(size=(9, 9))
    check_card("package.module:make", other)
    check_card("/:make", other)
    check_card(f"{tmp_path}/agent.pt2", other)  # without a card
    (tmp_path / "agent.json").write_text(json.dumps(CARD))
    check_card(f"{tmp_path}/mine.py:make", other)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"maps": []}', '{"maps": [{"name": "ego"}]}'])
def test_a_damaged_card_is_named(text, tmp_path):
    (tmp_path / "agent.json").write_text(text)
    with pytest.raises(PolicyError, match=r"agent\.json doesn't describe an exported agent"):
        check_card(f"{tmp_path}/agent.pt2", task())
