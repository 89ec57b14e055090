"""Ego and object flow in Newton, for several worlds at once.

In each world, a ball flies by and a crate tumbles in front of a camera that moves through the yard.

    pip install '.[examples]' newton
    python examples/newton_flow.py strip.png

It runs on a CPU. The first start takes a minute or more, because Warp compiles Newton's kernels.

`sensors_from("newton")` converts Newton's conventions. Note that:

- ids number the shapes of all worlds consecutively, so a shape has another id in each world;
- a camera sees the shapes of its world, and those that belong to no world (here the floor);
- call `bvh_refit_shapes` before rendering, or the picture shows old positions;
- a state has the poses of bodies (`body_q`), not of shapes.
"""

import math
import sys

import newton
import numpy as np
import torch
import warp as wp
from newton.sensors import SensorCamera
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv

import flowrep
from flowrep.geometry import intrinsics_from_fov
from flowrep.transforms import FlowFactorize, RawFlow, sensors_from

HEIGHT, WIDTH, FOV_DEG, PITCH_RAD = 80, 120, 60.0, 1.5
K = intrinsics_from_fov(FOV_DEG, axis="vertical", height=HEIGHT, width=WIDTH)
STEP_S, SUBSTEPS, FORWARD_MPS, TURN_RAD_S = 1 / 12, 10, 1.0, 0.3
BODIES = ("ball", "crate")
FLOOR = 0  # the first shape


class Yard(EnvBase):
    """Worlds in which a camera drives ahead; the action, -1 to 1, sets how fast it turns."""

    def __init__(self, num_worlds: int = 2) -> None:
        super().__init__(batch_size=[num_worlds])
        world = newton.ModelBuilder(gravity=(0, 0, -1))
        ball = world.add_body(xform=wp.transform((-1.5, 3.0, 1.0), wp.quat_identity()))
        world.add_shape_sphere(ball, radius=0.35)
        crate = world.add_body(xform=wp.transform((1.0, 4.0, 1.4), wp.quat_identity()))
        world.add_shape_box(crate, hx=0.5, hy=0.3, hz=0.3)
        yard = newton.ModelBuilder(gravity=(0, 0, -1))
        yard.add_ground_plane()
        yard.replicate(world, num_worlds)
        self.model = yard.finalize(device="cpu")
        self.solver = newton.solvers.SolverSemiImplicit(self.model)
        self.now, self.after = self.model.state(), self.model.state()
        self.sensor = SensorCamera(self.model)
        size = num_worlds, WIDTH, HEIGHT
        self.maps = {
            "forward_depth_image": self.sensor.allocate_image_depth_forward(*size),
            "shape_index_image": self.sensor.allocate_image_shape_index(*size),
        }
        self.rays = SensorCamera.compute_camera_rays_pinhole(
            WIDTH, HEIGHT, camera_fov=math.radians(FOV_DEG), device="cpu"
        )
        self.position, self.yaw = torch.zeros(num_worlds, 3), torch.zeros(num_worlds)
        buffers = {name: Unbounded(x.shape, dtype=x.dtype) for name, x in self.observe().items()}
        self.observation_spec = Composite(buffers, shape=self.batch_size)
        self.action_spec = Bounded(-1.0, 1.0, (num_worlds, 1))
        self.reward_spec = Unbounded((num_worlds, 1))

    def cameras(self) -> Tensor:
        """Returns the cameras' poses [N, 7], positions and quaternions (x, y, z, w)."""
        # Without rotation a camera looks down, along -z. Pitch it up about x, then turn it about z.
        sin_p, cos_p = math.sin(PITCH_RAD / 2), math.cos(PITCH_RAD / 2)
        sin_y, cos_y = (self.yaw / 2).sin(), (self.yaw / 2).cos()
        xyzw = torch.stack([cos_y * sin_p, sin_y * sin_p, sin_y * cos_p, cos_y * cos_p], -1)
        return torch.cat([self.position, xyzw], -1)

    def render(self) -> None:
        """Draws the maps of all worlds."""
        poses = wp.from_torch(self.cameras(), dtype=wp.transformf)
        self.model.bvh_refit_shapes(self.now)
        self.sensor.update(self.now, poses, self.rays, **self.maps)

    def observe(self) -> TensorDict:
        """Returns Newton's maps and poses in its conventions, with ids as in the first world."""
        self.render()
        ids = wp.to_torch(self.maps["shape_index_image"]).long()
        is_body = (ids != FLOOR) & (ids != 0xFFFFFFFF)
        return TensorDict(
            forward_depth=wp.to_torch(self.maps["forward_depth_image"]).clone(),
            shape_index=torch.where(is_body, 1 + (ids - 1) % len(BODIES), ids),
            camera_transforms=self.cameras(),
            body_q=wp.to_torch(self.now.body_q).reshape(-1, len(BODIES), 7).clone(),
            batch_size=self.batch_size,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        self.now.assign(self.model.state())
        speeds = [[1.2, 0.3, 0.8, 0, 0, 0], [-0.4, 0, 0.5, 0.8, 0.5, -0.7]]  # linear, angular
        worlds = np.linspace(0.7, 1.3, len(self.yaw))[:, None, None]
        self.now.body_qd.assign((worlds * speeds).reshape(-1, 6).astype(np.float32))
        self.position[:] = torch.tensor([0.0, 0.0, 1.2])
        self.yaw[:] = 0.0
        return self.observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.yaw += TURN_RAD_S * STEP_S * tensordict["action"][:, 0]
        ahead = torch.stack([-self.yaw.sin(), self.yaw.cos(), torch.zeros_like(self.yaw)], -1)
        self.position += FORWARD_MPS * STEP_S * ahead
        for _ in range(SUBSTEPS):
            self.now.clear_forces()
            self.solver.step(self.now, self.after, None, None, STEP_S / SUBSTEPS)
            self.now, self.after = self.after, self.now
        zeros = torch.zeros(len(self.yaw), 1)
        return self.observe().update({"reward": zeros, "done": zeros.bool()})

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_env(num_worlds: int = 2) -> TransformedEnv:
    """Returns the yards as a TorchRL env that adds raw, ego and obj to Newton's data."""
    sensors = sensors_from("newton", body_ids=[1, 2], static_ids=[FLOOR])
    return TransformedEnv(Yard(num_worlds), Compose(*sensors, RawFlow(K), FlowFactorize(K)))


def main(path: str | None = None) -> None:
    env = make_env()
    frames = env.rollout(12, policy=lambda td: td.set("action", torch.ones(2, 1)))["next"]
    print(flowrep.diagnose(frames, K))
    speed = frames["obj"].norm(dim=-3, keepdim=True)
    for row, name in enumerate(BODIES, start=1):
        median = speed[frames["sensor", "instance"] == row].median()
        print(f"median |obj| of the {name:5} {median:.2f} px")
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[0, 6]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=12.0))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:2])
