"""Flow in ViZDoom, verified by warping: what a pixel shows now was seen where flow says it was."""

import pytest
import torch

pytest.importorskip("vizdoom", reason="ViZDoom is not installed: pip install '.[examples]'")

from examples.vizdoom_flow import K, make_env
from flowrep import diagnose


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("doom"))  # ViZDoom writes a file where it runs
        env = make_env()
        env.set_seed(2)
        torch.manual_seed(2)  # of the actions
        frames = env.rollout(14)["next"]
        env.close()
    return frames


def test_depth_of_a_byte_confirms_nothing(frames):
    # Its steps hide much, and after some walks they look like a mistake, which is a known limit.
    assert not diagnose(frames, K).is_right


def test_monsters_alone_have_object_flow(frames):
    obj, moving = frames["obj"], frames["sensor", "instance"] > 0
    assert (obj.norm(dim=-3, keepdim=True)[moving] > 1).any()
    assert (obj.abs().amax(-3, keepdim=True)[~moving] == 0).all()
    rest = frames["raw"] - frames["ego"] - obj
    assert rest[frames["raw_valid"].expand_as(obj)].abs().max() < 1e-3
