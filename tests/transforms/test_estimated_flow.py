"""Estimated flow: sign, grid, channel order, sizes and units, by textures shifted by hand."""

import math
import re
import sys
import types

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional
from torchrl.data import Unbounded
from torchrl.envs import ParallelEnv, TransformedEnv
from torchrl.envs.transforms import Compose

from flowrep import transforms as T
from flowrep.geometry import ego_flow
from tests.transforms.fake_env import INTRINSICS, FakeSensorEnv
from tests.transforms.oracles import brightening


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """Returns smooth colour noise, uint8 [3, H, W], without symmetry or period."""
    noise = torch.rand(1, 3, height // 4, width // 4, generator=torch.Generator().manual_seed(seed))
    smooth = functional.interpolate(noise, size=(height, width), mode="bicubic")
    return (255 * smooth[0].clamp(0, 1)).to(torch.uint8)


def shifted_pair(height: int, width: int, right: int, down: int, seed: int = 0) -> Tensor:
    """Returns previous and current picture: between them all went `right` and `down`."""
    large = texture(height + 16, width + 16, seed)
    window = (slice(8, 8 + height), slice(8, 8 + width))
    now = large.roll((down, right), (-2, -1))[:, window[0], window[1]]
    return torch.cat([large[:, window[0], window[1]], now])


pytest.importorskip("cv2", reason="DIS is OpenCV's: pip install 'flowrep-rl[flow]'")


@pytest.mark.parametrize(("height", "width"), [(48, 64), (84, 60), (180, 200)])
def test_flow_is_now_minus_before_u_right_and_v_down(height, width):
    pair = shifted_pair(height, width, right=3, down=-2)
    flow = T.EstimatedFlow()(TensorDict({"rgb2": pair}))["raw"]
    u, v = flow[:, 8:-8, 8:-8].flatten(1).median(-1).values
    # Rivals: sign (-3, 2), channel order (-2, 3), flow of the enlarged picture (12, -8).
    torch.testing.assert_close(torch.stack([u, v]), torch.tensor([3.0, -2.0]), atol=0.1, rtol=0)


def test_the_estimator_runs_from_the_current_picture_to_the_previous_one():
    pair = shifted_pair(6, 8, right=1, down=2)

    def of_the_first_grid(first, second):
        return 1000.0 * first[:, :2] + second[:, :2]

    flow = T.EstimatedFlow(of_the_first_grid)(TensorDict({"rgb2": pair}))["raw"]
    previous, current = pair.float().chunk(2)
    # Rival: the flow from the previous to the current picture lies on the previous one's grid.
    assert torch.equal(flow, -(1000.0 * current[:2] + previous[:2]))


def test_the_preset_fine_keeps_the_flow_of_small_bodies():
    previous, body = texture(160, 160), texture(24, 8, seed=1)
    current = previous.clone()
    previous[:, 60:84, 70:78] = body
    current[:, 60:84, 72:80] = body  # 2 px to the right, a body of 8 px
    pair = TensorDict({"rgb2": torch.cat([previous, current])})
    medium, fine = (
        T.EstimatedFlow(preset=preset)(pair.clone())["raw"][0, 62:82, 73:79].median()
        for preset in ("medium", "fine")
    )
    assert fine == pytest.approx(2.0, abs=0.3)
    assert medium < 1.5


def test_a_picture_that_stayed_the_same_has_exactly_no_flow():
    def noisy(first, second):
        return torch.ones(len(first), 2, *first.shape[-2:])

    same, moved = texture(6, 8).repeat(2, 1, 1), shifted_pair(6, 8, 1, 0)
    flow = T.EstimatedFlow(noisy)(TensorDict({"rgb2": torch.stack([same, moved])}, [2]))["raw"]
    assert flow.flatten(1).tolist() == [[0.0] * 96, [-1.0] * 96]


@pytest.mark.parametrize("batch", [(), (3,), (2, 1), (0,)])
def test_a_batch_of_any_shape_equals_a_loop_whatever_the_number_of_threads(batch):
    count = torch.Size(batch).numel()
    pairs = torch.stack([shifted_pair(24, 40, i, 1 - i, seed=i) for i in range(max(1, count))])
    transform, threads = T.EstimatedFlow(), torch.get_num_threads()
    want = torch.stack([transform.compute(pair)[0] for pair in pairs])[:count]
    try:
        torch.set_num_threads(3)
        got = transform.compute(pairs[:count].reshape(*batch, 6, 24, 40))[0]
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(got, want.reshape(*batch, 2, 24, 40))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_pictures_on_a_gpu_have_their_flow_there():
    pair = shifted_pair(48, 64, 3, -2)
    flow = T.EstimatedFlow().compute(pair.cuda())[0]
    assert flow.device.type == "cuda"
    torch.testing.assert_close(flow.cpu(), T.EstimatedFlow().compute(pair)[0])


@pytest.mark.slow
def test_workers_forked_after_it_ran_here_estimate_too():
    def estimating():
        stack = T.representation_stack(["raw"], flow="estimated")
        return TransformedEnv(FakeSensorEnv(), stack)

    here = estimating().rollout(3)["next", "raw"]
    workers = ParallelEnv(2, estimating, mp_start_method="fork")
    try:
        apart = workers.rollout(3)["next", "raw"]
    finally:
        workers.close()
    assert torch.equal(apart, here.expand_as(apart))


def test_estimated_raw_alone_reads_pictures_alone():
    stack = T.representation_stack(["raw"], flow="estimated")
    assert {key for transform in stack for key in transform.in_keys} == {("sensor", "rgb"), "_rgb2"}


def test_pixels_that_an_estimator_does_not_know_have_flow_0_and_no_object_flow():
    def knows_the_left_half(current, previous):
        flow = brightening(current, previous)
        flow[..., 4:] = math.nan
        return flow

    pictures = T.FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=["rgb2"])
    factors = T.FlowFactorize(INTRINSICS, outputs=["obj", "valid"])
    stack = Compose(pictures, T.EstimatedFlow(knows_the_left_half), factors)
    td = TransformedEnv(FakeSensorEnv((2,)), stack).rollout(2)[:, 1]
    assert (td["raw"][..., :4] == -1.0).all()
    assert (td["raw"][..., 4:] == 0.0).all()
    assert not td["raw_valid"][..., 4:].any()
    assert (td["obj"][..., 4:] == 0.0).all()
    assert not td["valid"][..., 4:].any()


# fx 20, fy 30: 0.2 m to the right and 0.1 m down past a wall 2 m away move it by (-2, -1.5) px, in
# pictures twice as large by (-4, -3).
WALL_K = [[20.0, 0.0, 6.0], [0.0, 30.0, 4.0], [0.0, 0.0, 1.0]]


WALL = torch.full((1, 10, 14), 2.0)
EGO = torch.tensor([-2.0, -1.5]).reshape(2, 1, 1).expand(2, 10, 14)


def past_a_wall(pair, estimate, depth=WALL, K=WALL_K, moved=(0.2, 0.1, 0.0), scale=2):
    """Returns raw flow of pictures `scale` times the maps' size, and what the estimator saw."""
    motion, seen = torch.eye(4), []
    motion[:3, 3] = torch.tensor(moved)

    def estimator(current, previous):
        seen.extend([current, previous])
        return torch.tensor(estimate).reshape(1, 2, 1, 1).expand(1, 2, *pair.shape[-2:])

    flow = T.EstimatedFlow(estimator, intrinsics=K, picture_scale=scale)
    sensor = {"depth": depth, "prev_from_curr": motion}
    td = flow(TensorDict({"rgb2": pair, "sensor": sensor}))
    return td["raw"], *seen


def test_pictures_that_are_no_multiple_of_the_maps_are_refused():
    with pytest.raises(ValueError, match=r"20x28.*picture_scale=2.*10x13"):
        past_a_wall(shifted_pair(20, 28, 0, 0), [0.0, 0.0], WALL[..., 1:])


def test_pictures_are_compared_after_the_camera_s_motion_is_undone():
    pair = shifted_pair(20, 28, right=-4 + 2, down=-3 - 6)  # something moves by (2, -6) px, too
    raw, current, previous = past_a_wall(pair, [-2.0, 6.0])
    assert torch.equal(current[0], pair[3:])
    # Without the camera's motion, what is at (x, y) before is at (x + 2, y - 6) now.
    assert torch.equal(previous[..., 6:-3, :-4], current[..., :-9, 2:-2])
    # (2, -6) px of the pictures are (1, -3) of the maps. The pictures' last 3 rows and 4 columns,
    # 1.5 and 2 of the maps, were not to be seen before: ego flow alone.
    expected = torch.tensor([-2.0 + 1.0, -1.5 - 3.0]).reshape(2, 1, 1)
    torch.testing.assert_close(raw[:, :4, 2:11], expected.expand(2, 4, 9), atol=1e-5, rtol=0)
    torch.testing.assert_close(raw[:, :, 12:], EGO[:, :, 12:], atol=1e-5, rtol=0)
    torch.testing.assert_close(raw[:, 9:], EGO[:, 9:], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("right", "down", "contrast"),
    # only the camera moved; plain surfaces, and as good as plain
    [(-4, -3, 1.0), (-4 + 2, -3 - 6, 0.0), (-4 + 2, -3 - 6, 0.01)],
)
def test_an_estimate_that_does_not_explain_the_pictures_is_not_an_objects_flow(
    right, down, contrast
):
    pair = shifted_pair(20, 28, right=right, down=down).float()
    raw, *_ = past_a_wall((128 + contrast * (pair - 128)).to(torch.uint8), [-2.0, 6.0])
    torch.testing.assert_close(raw, EGO, atol=1e-5, rtol=0)


def test_an_estimate_that_is_not_finite_is_not_known_even_with_the_camera_compensated():
    def half(current, previous):
        flow = torch.zeros(1, 2, 20, 28)
        flow[..., 14:] = torch.nan
        return flow

    sensor = {"depth": torch.full((1, 20, 28), 2.0), "prev_from_curr": torch.eye(4)}
    pair = shifted_pair(20, 28, right=1, down=0)
    td = T.EstimatedFlow(half, intrinsics=WALL_K)(TensorDict({"rgb2": pair, "sensor": sensor}))
    assert torch.equal(td["raw_valid"][0, 0], torch.arange(28) < 14)
    assert not td["raw"].any()


def test_where_depth_is_not_known_the_camera_s_share_is_that_of_neighbours():
    depth = WALL.clone()
    depth[0, 5, 6], depth[0, 2, 9] = 0.0, torch.nan
    raw, *_ = past_a_wall(shifted_pair(20, 28, right=-4, down=-3), [0.0, 0.0], depth)
    torch.testing.assert_close(raw, EGO, atol=1e-5, rtol=0)  # rival: 0 there, and less around it


def test_between_the_maps_pixels_the_camera_s_share_is_smooth():
    # 0.5 m ahead towards a wall now 2 m away shrinks a ramp of 6 a pixel to 0.8 of that, 4.8.
    ramp = (6 * torch.arange(40)).to(torch.uint8).expand(3, 16, 40)
    camera = {"K": [[20.0, 0.0, 5.0], [0.0, 30.0, 2.0], [0.0, 0.0, 1.0]], "moved": (0, 0, 0.5)}
    pair, wall = torch.cat([ramp, ramp.flip(-1)]), torch.full((1, 4, 10), 2.0)
    _, _, warped = past_a_wall(pair, [0.0, 0.0], wall, **camera, scale=4)
    steps = warped[0].int().diff()[..., 2:-3]  # half a pixel of the maps from the border
    assert set(steps.unique().tolist()) == {4, 5}  # rival: 6, 6, 6 and then 1


def test_the_camera_s_share_is_that_of_the_place_where_the_estimate_was_found():
    # 0.5 m ahead towards a wall now 2 m away: all goes 0.5 / 2.5 of its distance from (4, 2) out.
    camera = {"K": [[20.0, 0.0, 4.0], [0.0, 30.0, 2.0], [0.0, 0.0, 1.0]], "moved": (0, 0, 0.5)}
    given = {"estimate": [-1.0, 2.0], "depth": torch.full((1, 12, 16), 2.0), "scale": 1} | camera
    before = shifted_pair(12, 16, right=1, down=0)[:3]
    _, _, warped = past_a_wall(torch.cat([before, before.flip(0)]), **given)
    now = warped[0].roll((-2, 1), (-2, -1))  # what the estimate says
    raw, *_ = past_a_wall(torch.cat([before, now]), **given)
    # Rival: the share of the pixel itself, 0.2 * (4.5 - 4) and so on.
    u = 1.0 + 0.2 * (torch.arange(16) + 0.5 - 1.0 - 4.0)
    v = -2.0 + 0.2 * (torch.arange(12) + 0.5 + 2.0 - 2.0)
    expected = torch.stack(torch.meshgrid(u[3:], v[:8], indexing="xy"))
    # the rest is near rows and columns that came round
    torch.testing.assert_close(raw[:, :8, 3:], expected, atol=1e-5, rtol=0)


def test_raw_flow_beside_object_flow_is_estimated_with_the_camera_compensated():
    def still(current, previous):
        return torch.zeros(len(current), 2, 5, 7)

    options = {"raw": {"scale": 4.0}, "ego": {"scale": 2.0}, "obj": {"scale": 8.0}}
    flow = {"source": "estimated", "estimator": still}
    stack = T.representation_stack(options, intrinsics=INTRINSICS, flow=flow)
    td = TransformedEnv(FakeSensorEnv((2,)), stack).rollout(2)[:, 1]
    sensor = td["sensor"]
    ego, _ = ego_flow(sensor["depth"], torch.tensor(INTRINSICS), sensor["prev_from_curr"])
    assert ego.abs().amax() > 0.5
    for got, expected in [(sensor["flow"], ego), (td["raw"], 4 * ego), (td["ego"], 2 * ego)]:
        torch.testing.assert_close(got, expected)
    torch.testing.assert_close(td["obj"], torch.zeros_like(ego), atol=1e-4, rtol=0)


def test_flow_of_larger_pictures_is_averaged_to_the_maps():
    def columns_and_rows(current, previous):
        u = torch.arange(6.0).expand(len(current), 4, 6)
        return torch.stack([u, 10 * torch.arange(4.0)[:, None].expand_as(u)], 1)

    flow = T.EstimatedFlow(columns_and_rows, picture_scale=2)
    raw = flow(TensorDict({"rgb2": shifted_pair(4, 6, right=1, down=1)}))["raw"]
    # the mean of two columns, in pixels twice as large; rival: every second one, 0 and -1 and -2
    assert torch.equal(raw[0], torch.tensor([[-0.25, -1.25, -2.25]]).expand(2, 3))
    assert torch.equal(raw[1], torch.tensor([[-2.5], [-12.5]]).expand(2, 3))
    with pytest.raises(ValueError, match=r"5x6.*picture_scale=2"):
        flow.output_specs(Unbounded((6, 5, 6)))


def test_without_opencv_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"cv2.*'flowrep-rl\[flow\]'"):
        T.EstimatedFlow()


# OpenCV's layout, of which a reshape would mix u and v; one that would be repeated for all three
@pytest.mark.parametrize("shape", [(3, 5, 7, 2), (1, 2, 5, 7)])
def test_an_estimator_s_flow_of_another_shape_is_refused(shape):
    pairs = TensorDict({"rgb2": torch.zeros(3, 6, 5, 7, dtype=torch.uint8)}, [3])
    got = re.escape(f"[3, 2, 5, 7], got {[*shape]}")
    with pytest.raises(ValueError, match=rf"'raw'.* \[N, 2, H, W\], {got}"):
        T.EstimatedFlow(lambda first, second: torch.ones(shape))(pairs)


class KnownNetwork(nn.Module):
    """Says that all went 12 px right and 6 px up; keeps what it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.0))
        self.shown: list[torch.Tensor] = []

    def forward(self, first, second):
        self.shown = [first, second]
        motion = self.factor * torch.tensor([12.0, -6.0]).reshape(1, 2, 1, 1)
        wrong = torch.zeros(len(first), 2, *first.shape[-2:])
        return [wrong, wrong, wrong + motion]


@pytest.fixture
def weights(tmp_path, monkeypatch):
    network = types.SimpleNamespace(raft_small=lambda weights: KnownNetwork())
    monkeypatch.setattr(T.estimated_flow, "_optical_flow", lambda: network)
    path = tmp_path / "weights.pth"
    torch.save({"factor": torch.tensor(1.0)}, path)
    return path


@pytest.mark.parametrize(
    ("size", "shown", "flow"),
    [
        ((50, 84), (152, 256), [4.0, -2.0]),  # 3 times that reaches 128: 150 x 252, then padded
        ((129, 140), (136, 144), [12.0, -6.0]),
    ],
)
def test_small_pictures_are_enlarged_then_padded_and_their_flow_scaled_back(
    weights, size, shown, flow
):
    first = torch.zeros(2, 3, *size, dtype=torch.uint8)
    first[..., 0, 0] = 255  # padding on the right and below: the first corner stays where it is
    estimator = T.RAFT(weights)
    got = estimator(first, first)
    assert got.shape == (2, 2, *size)
    assert got[0, :, 7, 9].tolist() == flow
    picture = estimator.network.shown[0]
    assert picture.shape == (2, 3, *shown)
    assert (picture.min(), picture.max(), picture[0, 0, 0, 0]) == (-1, 1, 1)


def test_raw_flow_is_its_answer_negated(weights):
    pair = torch.zeros(6, 40, 50, dtype=torch.uint8)
    pair[3:] = 1
    transform = T.EstimatedFlow("raft_small", weights=weights).train()
    assert transform.compute(pair)[0][:, 0, 0].tolist() == [-3.0, 1.5]  # a factor of 4: 160 px
    assert not any(module.training for module in transform.estimator.modules())


def test_safetensors_are_read_too(weights):
    safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")
    path = weights.with_suffix(".safetensors")
    safetensors.save_file({"factor": torch.tensor(2.0)}, path)
    pictures = torch.zeros(1, 3, 128, 128, dtype=torch.uint8)
    assert T.RAFT(path)(pictures, pictures)[0, :, 0, 0].tolist() == [24.0, -12.0]


def test_a_file_without_rafts_weights_is_refused_by_name(weights, tmp_path):
    for garbage in (tmp_path / "w.pth", tmp_path / "w.safetensors"):
        garbage.write_bytes(b"garbage")
        with pytest.raises(ValueError, match=f"'{garbage}' is not a readable weights file"):
            T.RAFT(garbage)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pth"):
        T.RAFT(tmp_path / "nowhere.pth")
    other = tmp_path / "other.pth"
    torch.save({"bias": torch.zeros(1)}, other)
    with pytest.raises(ValueError, match=r"other\.pth.*raft_small"):
        T.RAFT(other)
    with pytest.raises(ValueError, match="raft_tiny"):
        T.RAFT(weights, "raft_tiny")
    with pytest.raises(ValueError, match="at least 128"):
        T.RAFT(weights, min_side_px=96)


def test_torchvisions_network_takes_small_pictures(tmp_path):
    try:
        from torchvision.models.optical_flow import raft_small
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"no torchvision for this torch ({str(error).splitlines()[0]})")
    path = tmp_path / "random.pth"
    torch.save(raft_small(weights=None).state_dict(), path)
    pictures = torch.randint(0, 256, (2, 2, 3, 40, 52), dtype=torch.uint8)
    flow = T.RAFT(path)(*pictures)
    assert flow.shape == (2, 2, 40, 52)
    assert flow.isfinite().all()
