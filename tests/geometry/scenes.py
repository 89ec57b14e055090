"""Inputs for the geometry's tests: asymmetric, so that a swap of anything shows."""

import math
from itertools import product

import torch
from torch import Tensor

HEIGHT, WIDTH = 5, 7
K = torch.tensor([[11.0, 0.7, 2.6], [0.0, 6.0, 3.1], [0.0, 0.0, 1.0]], dtype=torch.float64)


def rotation(x_rad: float, y_rad: float, z_rad: float) -> Tensor:
    """Returns Rz Ry Rx `[3, 3]`, float64."""
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in (x_rad, y_rad, z_rad))
    about_x = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=torch.float64)
    about_y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=torch.float64)
    about_z = torch.tensor([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]], dtype=torch.float64)
    return about_z @ about_y @ about_x


def rigid(angles_rad: tuple[float, float, float], translation_m: tuple[float, float, float]):
    """Returns a rigid transform `[4, 4]`, float64."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = rotation(*angles_rad)
    transform[:3, 3] = torch.tensor(translation_m, dtype=torch.float64)
    return transform


MOTION = rigid((0.03, -0.05, 0.02), (0.11, -0.07, 0.6))
OTHER_MOTION = rigid((-0.02, 0.04, 0.01), (-0.4, 0.2, 0.3))


def depth_map(*batch: int, seed: int = 0) -> Tensor:
    """Returns depth between 2 and 20 m, `[*B, 1, 5, 7]`, float64."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, 1, HEIGHT, WIDTH)
    return 2 + 18 * torch.rand(shape, generator=generator, dtype=torch.float64)


def instance_map(*batch: int, count: int = 3, dtype=torch.uint8) -> Tensor:
    """Returns ids from 0 to `count` - 1, `[*B, 1, 5, 7]`."""
    generator = torch.Generator().manual_seed(4)
    return torch.randint(count, (*batch, 1, HEIGHT, WIDTH), generator=generator).to(dtype)


def raw_flow(*batch: int) -> Tensor:
    """Returns flow of some pixels, `[*B, 2, 5, 7]`, float64."""
    generator = torch.Generator().manual_seed(6)
    return 5 * torch.randn((*batch, 2, HEIGHT, WIDTH), generator=generator, dtype=torch.float64)


def assert_equals_a_loop(function, batch, *maps, atol=0.0) -> tuple[Tensor, ...]:
    """Compares each part of a batch's result with that of its elements one by one; returns it."""
    together = function(*maps)
    for at in product(*map(range, batch)):
        for part, alone in zip(together, function(*(each[at] for each in maps))):
            torch.testing.assert_close(part[at], alone, rtol=0, atol=atol)
    return together


def spoilt(tame: Tensor, share: float | Tensor, generator: torch.Generator) -> Tensor:
    """Returns tame numbers of which a share has any size and sign, or is nan, inf, 0 or 1."""
    sizes = 10 ** (100 * torch.rand(tame.shape, generator=generator, dtype=torch.float64) - 50)
    signs = torch.randn(tame.shape, generator=generator).sign()
    special = torch.tensor([math.nan, math.inf, -math.inf, 0.0, 1.0], dtype=torch.float64)
    pick = torch.randint(0, 30, tame.shape, generator=generator)
    wild = torch.where(pick < 5, special[pick.clamp(max=4)], sizes * signs)
    return torch.where(torch.rand(tame.shape, generator=generator) < share, wild, tame)


def flow_pixel_by_pixel(depth, K, motion, prev_K=None, instance=None) -> Tensor:
    """Returns flow `[2, H, W]`, unbatched, in plain floats: unproject, move, project to before.

    With ids, `motion` has a row for each. Flow is 0 where depth is nan.
    """
    (fx, skew, cx), (_, fy, cy), _ = K.tolist()
    (fx_p, skew_p, cx_p), (_, fy_p, cy_p), _ = (K if prev_K is None else prev_K).tolist()
    out = torch.zeros(2, *depth.shape[-2:], dtype=torch.float64)
    for row, column in product(*map(range, depth.shape[-2:])):
        z = depth[0, row, column].item()
        if math.isnan(z):
            continue
        # A point at infinity is a direction: the translation does not move it.
        z, w = (1.0, 0.0) if math.isinf(z) else (z, 1.0)
        rows = (motion if instance is None else motion[instance[0, row, column].item()]).tolist()
        y = z * (row + 0.5 - cy) / fy
        x = (z * (column + 0.5 - cx) - skew * y) / fx
        before = [r[0] * x + r[1] * y + r[2] * z + r[3] * w for r in rows]
        u = (fx_p * before[0] + skew_p * before[1]) / before[2] + cx_p
        v = fy_p * before[1] / before[2] + cy_p
        out[0, row, column], out[1, row, column] = column + 0.5 - u, row + 0.5 - v
    return out
