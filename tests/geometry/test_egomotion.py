"""The camera's motion from flow and depth: laws, measured thresholds, and what tells nothing."""

import math

import pytest
import torch

from flowrep import geometry as g
from flowrep.geometry.pose import rotation_from_vector
from tests.geometry.scenes import assert_equals_a_loop, rigid, spoilt

SIZE = 84
CAMERA = torch.tensor([[72.7, 0.0, 40.0], [0.0, 66.1, 45.0], [0.0, 0.0, 1.0]])
SCENES = ["straight_road", "s_turn", "h_shaped_pathways", "three_way_junction"]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def blocks(count: int = 16, seed: int = 0) -> torch.Tensor:
    """Returns depth of blocks 2 to 10 m away, `[count, 1, 84, 84]`."""
    coarse = 2 + 8 * torch.rand(count, 1, 6, 6, generator=seeded(seed))
    return torch.nn.functional.interpolate(coarse, size=(SIZE, SIZE))


def motions(count: int = 16, seed: int = 1) -> torch.Tensor:
    generator = seeded(seed)
    motion = torch.eye(4).repeat(count, 1, 1)
    motion[:, :3, :3] = rotation_from_vector(0.02 * torch.randn(count, 3, generator=generator))
    motion[:, :3, 3] = torch.randn(count, 3, generator=generator) * torch.tensor([0.05, 0.05, 0.2])
    return motion


def errors(got, motion, depth, camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns errors of rotation in degrees, translation in metres, ego flow in px (medians)."""
    turn = got[..., :3, :3].double().mT @ motion[..., :3, :3].double()
    # R - R^T is 2 sin(angle) [axis], whose norm is sqrt(8) sin(angle).
    sine = (turn - turn.mT).flatten(1).norm(dim=-1) / math.sqrt(8)
    miss = g.ego_flow(depth, camera, got).flow - g.ego_flow(depth, camera, motion).flow
    return (
        torch.rad2deg(sine),
        (got - motion)[..., :3, 3].norm(dim=-1),
        miss.norm(dim=-3).flatten(1).median(-1).values,
    )


def test_the_motion_of_a_flow_is_the_one_that_caused_it():
    # A turn to the right and 0.5 m ahead; prev_from_curr, so T is where the camera came from. The
    # rival curr_from_prev would have -0.5 and the opposite turn.
    motion = rigid((0.01, -0.04, 0.02), (0.1, -0.05, 0.5)).float()
    depth = blocks(1)[0]
    estimate = g.camera_motion(g.ego_flow(depth, CAMERA, motion).flow, depth, CAMERA)
    assert estimate.valid
    assert estimate.inlier_share == 1.0
    torch.testing.assert_close(estimate.prev_from_curr, motion, rtol=0, atol=1e-5)


def test_a_zoom_between_the_frames_is_no_motion_of_the_camera():
    camera = torch.tensor([[90.0, 4.0, 30.0], [0.0, 40.0, 51.0], [0.0, 0.0, 1.0]]).double()
    depth, motion = blocks(3).double(), motions(3).double()
    motion[0] = torch.eye(4)
    before = camera * torch.tensor([[0.96, 0.9, 1.04], [1.0, 0.96, 1.0], [1.0, 1.0, 1.0]])
    flow = g.ego_flow(depth, camera, motion, prev_K=before).flow
    estimate = g.camera_motion(flow, depth, camera, prev_K=before)
    assert estimate.valid.all()
    torch.testing.assert_close(estimate.prev_from_curr, motion, rtol=0, atol=1e-6)
    assert estimate.covariance.dtype == torch.float64
    one_K = g.camera_motion(flow, depth, camera).prev_from_curr
    assert (one_K[0] - motion[0])[2, 3] > 0.05  # taken for a drive ahead


def test_no_flow_is_exactly_no_motion():
    estimate = g.camera_motion(torch.zeros(2, SIZE, SIZE), blocks(1)[0], CAMERA)
    assert estimate.valid
    assert torch.equal(estimate.prev_from_curr, torch.eye(4))


@pytest.mark.parametrize("batch", [(3,), (2, 1)])
def test_a_frame_s_motion_does_not_depend_on_its_batch(batch):
    count = math.prod(batch)
    depth, motion = blocks(count), motions(count)
    flow = g.ego_flow(depth, CAMERA, motion).flow
    flow += 0.2 * torch.randn(flow.shape, generator=seeded(3))
    picture = (255 * torch.rand(count, 3, SIZE, SIZE, generator=seeded(4))).to(torch.uint8)
    maps = [x.reshape(*batch, *x.shape[1:]) for x in (flow, depth, picture, motion)]

    def estimate(flow, depth, picture, prior):
        return g.camera_motion(flow, depth, CAMERA, picture=picture, prior=prior)

    for part, repeated in zip(estimate(*maps), estimate(*maps)):
        assert part.shape[: len(batch)] == batch
        assert torch.equal(part, repeated)
    assert_equals_a_loop(lambda *maps: estimate(*maps)[:1], batch, *maps, atol=1e-4)


def test_noise_of_a_third_of_a_pixel_and_a_covariance_that_says_so():
    depth, motion = blocks(64), motions(64)
    flow = g.ego_flow(depth, CAMERA, motion).flow
    flow += 0.3 * torch.randn(flow.shape, generator=seeded(5))
    got = g.camera_motion(flow, depth, CAMERA)
    turn, shift, _ = errors(got.prev_from_curr, motion, depth, CAMERA)
    assert turn.median() < 0.03
    assert shift.median() < 0.003
    variance = got.covariance.diagonal(dim1=-2, dim2=-1)
    said_turn = torch.rad2deg(variance[:, :3].sum(-1).mean().sqrt())
    said_shift = variance[:, 3:].sum(-1).mean().sqrt()
    assert 0.7 < said_turn / turn.square().mean().sqrt() < 1.4
    assert 0.7 < said_shift / shift.square().mean().sqrt() < 1.4


def scene_of(height: int, width: int, count: int) -> tuple[torch.Tensor, ...]:
    """Returns depth, K, the camera's flow and a body's, each `count` times."""
    camera = torch.tensor([[0.9 * width, 0, 0.48 * width], [0, 0.8 * width, 0.53 * height]])
    camera = torch.cat([camera, torch.tensor([[0.0, 0.0, 1.0]])])
    depth = torch.nn.functional.interpolate(blocks(count), size=(height, width))
    motion = motions(count)
    own = motions(count, seed=2)
    own[:, :2, 3] *= 3.0
    return depth, camera, *(g.ego_flow(depth, camera, m).flow for m in (motion, motion @ own))


def bodies(height: int, width: int, share: float) -> dict[str, torch.Tensor]:
    """Returns bool [H, W] of bodies of many shapes, each over `share` of the pixels."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    keys = {"left": x, "right": -x, "top": y, "bottom": -y}
    keys["block"] = torch.maximum((x / width - 0.4).abs(), (y / height - 0.6).abs())
    keys["corner"] = torch.maximum(x / width, y / height)
    along = (x + width * y) / (width * height)  # which of equal ones come first
    for period in (2, 3, 4, 8, 12):
        half = max(1, period // 2)
        keys |= {f"columns {period}": x % period + along, f"rows {period}": y % period + along}
        keys[f"squares {period}"] = (x // half + y // half) % 2 + along
    keys["dust"] = torch.rand(height, width, generator=seeded())
    number = int(share * height * width)
    masks = {}
    for name, key in keys.items():
        mask = torch.zeros(height * width, dtype=torch.bool)
        mask[key.flatten().double().argsort(stable=True)[:number]] = True
        masks[name] = mask.reshape(height, width)
    return masks


SIZES = [(40, 48), (48, 48), (84, 84), (60, 80), (480, 640)]


@pytest.mark.slow_after_first
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_body_over_49_percent_of_the_picture_is_never_the_world(size):
    depth, camera, world, body = scene_of(*size, count=4 if size[0] < 480 else 1)
    for name, mask in bodies(*size, share=0.49).items():
        got = g.camera_motion(torch.where(mask, body, world), depth, camera)
        miss = g.ego_flow(depth, camera, got.prev_from_curr).flow - world
        assert miss.norm(dim=1).max() < 0.05, name
        assert got.valid.all(), name
        assert (got.inlier_share - 0.51).abs().max() < 0.05, name  # of 1,536 pixels


@pytest.mark.slow_after_first
@pytest.mark.parametrize("size", SIZES[:4], ids=str)
def test_movers_over_40_percent_and_noise_of_a_third_of_a_pixel(size):
    depth, camera, world, body = scene_of(*size, count=4)
    wrong, noise = [], seeded(7)
    for mask in bodies(*size, share=0.4).values():
        flow = torch.where(mask, body, world)
        flow = flow + 0.3 * torch.randn(flow.shape, generator=noise)
        got = g.camera_motion(flow, depth, camera)
        miss = (g.ego_flow(depth, camera, got.prev_from_curr).flow - world).norm(dim=1)
        size_px = world.norm(dim=1).flatten(1).median(-1).values
        wrong.append((miss.flatten(1).median(-1).values > 0.5 * size_px) | ~got.valid)
    assert torch.stack(wrong).float().mean() <= 1 / 40


def test_a_motion_between_two_bodies_does_not_win_the_final_choice():
    # A wall at 4 m, f = 40 px: 0.1 m sideways is 1 px. It stands, 40 % of it moved by 1 px. What
    # lies 0.2 px from the one and 0.8 px from the other explains some of both.
    camera = torch.tensor([[40.0, 0, 24], [0, 40, 20], [0, 0, 1]]).double()[None]
    flow = 0.3 * torch.randn(1, 2, 40, 48, generator=seeded())
    flow[0, 0, :, 29:] += 1.0
    between = torch.eye(4).double().repeat(1, 3, 1, 1)
    between[0, :, 0, 3] = torch.tensor([0.0, -0.8, -4.0])  # 40 px times 0, -0.02 and -0.1 m
    depth, known = torch.full((1, 1, 40, 48), 4.0), torch.ones(1, dtype=torch.bool)
    values, _ = g.egomotion._voters(flow, depth, camera, None, None, known)
    voters = g.egomotion._samples_of(values[..., :-1], between)
    *_, squared = g.egomotion._residuals(voters, between.float(), 3)
    votes = g.egomotion._votes(squared, g.egomotion._variance(squared).amin(1, keepdim=True), 1.0)
    assert votes[0].argsort(descending=True).tolist() == [0, 1, 2]


@pytest.mark.slow_after_first
@pytest.mark.parametrize("deviation_px", [0.5, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("size", SIZES[::2], ids=str)
def test_flow_that_is_noise_is_no_motion_and_looks_like_none(size, deviation_px):
    count = 8 if size[0] < 480 else 2
    depth, camera, world, _ = scene_of(*size, count=count)
    noise = torch.randn(world.shape, generator=seeded(8))
    picture = 255 * torch.rand(count, 3, *size, generator=seeded(9))
    for options in ({}, {"picture": picture}):
        of_noise = g.camera_motion(deviation_px * noise, depth, camera, **options)
        assert not of_noise.valid.any()
        assert torch.equal(of_noise.prev_from_curr, torch.eye(4).expand(count, 4, 4))
        assert (of_noise.inlier_share < 0.3).all()
        right = g.camera_motion(world + 0.3 * noise, depth, camera, **options)
        assert right.valid.all()
        assert (right.inlier_share > 0.9).all()


def test_a_camera_that_stands_is_told_from_noise_by_its_size():
    depth, camera, world, _ = scene_of(84, 84, count=16)
    noise = 0.1 * torch.randn(world.shape, generator=seeded(8))
    got = g.camera_motion(noise, depth, camera)
    assert got.valid.all()
    assert (got.inlier_share > 0.9).all()
    assert g.ego_flow(depth, camera, got.prev_from_curr).flow.abs().max() < 0.1


SPOILT = {
    "K": (1, 1, math.nan),
    "K of 0": (0, 0, 0.0),
    "prev_K": (0, 2, math.inf),
    "prior": (2, 3, math.nan),
    "prior without bound": (0, 0, 1e30),
}


@pytest.mark.parametrize("what", SPOILT)
def test_what_is_not_known_of_a_frame_makes_it_alone_invalid(what):
    depth, camera, world, _ = scene_of(40, 48, count=3)
    given = {"K": camera.repeat(3, 1, 1), "prior": motions(3)}
    given["prev_K"] = given["K"].clone()
    right = g.camera_motion(world, depth, **given)
    row, column, value = SPOILT[what]
    given[what.split()[0]][1, row, column] = value
    got = g.camera_motion(world, depth, **given)
    assert got.valid.tolist() == [True, False, True]
    assert got.inlier_share[1] == 0
    for part, expected in zip(got, right):
        torch.testing.assert_close(part[::2], expected[::2])
    expected = torch.eye(4) if "prior" in what else given["prior"][1]
    assert torch.equal(got.prev_from_curr[1], expected)


@pytest.mark.parametrize("size", [(0, 48), (40, 0), (0, 0), (1, 1)])
@pytest.mark.parametrize("batch", [(), (2,), (0,)])
def test_pictures_of_no_pixels_or_one_tell_no_motion(size, batch):
    flow, depth = torch.zeros(*batch, 2, *size), torch.ones(*batch, 1, *size)
    got = g.camera_motion(flow, depth, CAMERA, picture=torch.zeros(*batch, 3, *size))
    assert got.valid.shape == batch
    assert not got.valid.any()
    assert torch.equal(got.prev_from_curr, torch.eye(4).expand(*batch, 4, 4))


def test_no_input_raises_or_reaches_another_frame():
    depth, camera, world, _ = scene_of(40, 48, count=64)
    right = g.camera_motion(world, depth, camera)
    generator = seeded(10)

    def wild(tensor: torch.Tensor) -> torch.Tensor:
        """Returns every second frame with wild numbers here and there."""
        share = torch.rand(len(tensor), *[1] * (tensor.ndim - 1), generator=generator)
        share[1::2] = 0.0
        return spoilt(tensor, share, generator).to(tensor.dtype)

    cameras = wild(camera.repeat(64, 1, 1))
    for given in ((wild(world), depth, camera), (world, wild(depth), cameras)):
        got = g.camera_motion(*given)
        assert all(not part.isnan().any() for part in got)
        torch.testing.assert_close(
            got.prev_from_curr[1::2], right.prev_from_curr[1::2], rtol=0, atol=1e-5
        )


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_estimated_flow_of_a_street_gives_nearly_the_motion(scene):
    envs, baselines = (pytest.importorskip(f"flowrep.{name}") for name in ("envs", "baselines"))
    pytest.importorskip("cv2")
    from flowrep.transforms import DIS

    env = envs.make_env(scene, ["rgb"], keep_sensor=True, num_envs=2, seed=0)
    planner, K = baselines.BaselinePolicy("planner"), torch.as_tensor(envs.street_envs(env)[0].K)
    planner.enter(env)
    drive = env.rollout(30, lambda td: planner(td.set("env_id", torch.arange(2))))[:, ::2]
    env.close()
    before, now = (each.flatten() for each in (drive, drive["next"]))
    seen, flow = now["sensor"], -DIS()(now["rgb"], before["rgb"])
    got = g.camera_motion(flow, seen["depth"], K.float(), picture=now["rgb"])
    turn, shift, ego = errors(got.prev_from_curr, seen["prev_from_curr"], seen["depth"], K.float())
    moved = seen["prev_from_curr"][:, :3, 3].norm(dim=-1)
    assert ego.median() <= 0.30
    assert (shift / moved).median() <= 0.13
    assert turn.median() <= 0.2
    assert (ego > 0.5).float().mean() <= 0.25


def few_pixels() -> torch.Tensor:
    depth = torch.full((1, SIZE, SIZE), math.nan)
    depth[0, 40:44, 40:44] = 5.0
    return depth


def edges() -> torch.Tensor:
    """Returns a picture of vertical edges alone, which tell nothing of a shift along them."""
    return (255.0 * (torch.arange(SIZE) % 12 < 2)).expand(3, SIZE, SIZE)


FLAT, SKY = torch.full((1, SIZE, SIZE), 5.0), torch.full((1, SIZE, SIZE), math.inf)
TURN, RISE = rigid((0.01, 0.02, -0.01), (0, 0, 0)).float(), rigid((0, 0, 0), (0, 0.1, 0.3)).float()
TELLS_NOTHING = {
    "unknown flow": (torch.full((2, SIZE, SIZE), math.nan), FLAT, {}),
    "unknown depth": (torch.zeros(2, SIZE, SIZE), FLAT * math.nan, {}),
    "16 pixels": (torch.randn(2, SIZE, SIZE, generator=seeded()), few_pixels(), {}),
    "no texture": (
        torch.randn(2, SIZE, SIZE, generator=seeded()),
        FLAT,
        {"picture": torch.full((3, SIZE, SIZE), 90, dtype=torch.uint8)},
    ),
    "sky alone": (g.ego_flow(SKY, CAMERA, TURN).flow, SKY, {}),
    "one direction of edges": (g.ego_flow(FLAT, CAMERA, RISE).flow, FLAT, {"picture": edges()}),
}
OPEN = {"sky alone": [3, 4, 5], "one direction of edges": [4], "16 pixels": None}


@pytest.mark.parametrize("case", TELLS_NOTHING)
def test_what_tells_no_motion_gives_the_identity_and_says_so(case):
    flow, depth, options = TELLS_NOTHING[case]
    got = g.camera_motion(flow, depth, CAMERA, **options)
    assert not got.valid
    assert torch.equal(got.prev_from_curr, torch.eye(4))
    assert 0 <= got.inlier_share <= 1
    assert not got.covariance.isnan().any()
    variance = got.covariance.diagonal()
    if OPEN.get(case, range(6)) is not None:
        assert variance.isinf().nonzero().flatten().tolist() == list(OPEN.get(case, range(6)))
    off_diagonal = got.covariance - torch.diag(torch.nan_to_num(variance, posinf=0.0))
    assert off_diagonal[~torch.eye(6).bool()].isfinite().all()
    prior = rigid((0.1, 0.0, 0.0), (0.0, 0.0, 0.4)).float()
    assert torch.equal(
        g.camera_motion(flow, depth, CAMERA, prior=prior, **options).prev_from_curr, prior
    )


def test_a_prior_decides_for_the_world_against_a_body_that_fills_more():
    depth, motion = blocks(8), motions(8)
    flow = g.ego_flow(depth, CAMERA, motion).flow
    body = motion @ rigid((0.02, 0.0, 0.01), (0.15, 0.1, 0.0)).float()
    flow[..., 36:] = g.ego_flow(depth, CAMERA, body).flow[..., 36:]  # 57 % of the picture
    flow += 0.05 * torch.randn(flow.shape, generator=seeded(6))
    follows_the_body = g.camera_motion(flow, depth, CAMERA)
    guided = g.camera_motion(
        flow, depth, CAMERA, prior=motion @ rigid((0, 0.002, 0), (0, 0, 0.01)).float()
    )
    assert errors(follows_the_body.prev_from_curr, motion, depth, CAMERA)[2].median() > 0.5
    assert (errors(guided.prev_from_curr, motion, depth, CAMERA)[2] < 0.05).all()


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_a_prior_that_is_a_smaller_body_s_motion_does_not_win(noise_px):
    depth, motion = blocks(8), motions(8)
    body = motion @ rigid((0.02, 0.0, 0.01), (0.15, 0.1, 0.0)).float()
    flow = g.ego_flow(depth, CAMERA, motion).flow
    flow[..., 56:] = g.ego_flow(depth, CAMERA, body).flow[..., 56:]  # a third of the picture
    flow += noise_px * torch.randn(flow.shape, generator=seeded(6))
    got = g.camera_motion(flow, depth, CAMERA, prior=body)
    assert (errors(got.prev_from_curr, motion, depth, CAMERA)[2] < 0.05).all()


@pytest.mark.slow
def test_it_compiles_to_one_graph_and_has_no_gradient():
    depth, motion = blocks(2), motions(2)
    flow = g.ego_flow(depth, CAMERA, motion).flow.requires_grad_()
    eager = g.camera_motion(flow, depth, CAMERA)
    assert not eager.prev_from_curr.requires_grad
    compiled = torch.compile(g.camera_motion, fullgraph=True, backend="eager")(flow, depth, CAMERA)
    torch.testing.assert_close(compiled.prev_from_curr, eager.prev_from_curr)
