"""Ego and object flow of two frames by pure functions on tensors, without env or TensorDict.

A camera drives half a metre ahead while a person in front of it takes a step to the right.

    python examples/tensors.py
"""

import torch

from flowrep.geometry import factorize, instance_motion, intrinsics_from_fov, rigid_flow


def main() -> None:
    K = intrinsics_from_fov(90.0, axis="vertical", height=6, width=8)  # fx = fy = 3 px

    # Poses at the previous and the current frame: camera-to-world, x right, y down, z forward.
    world_from_prev_cam, world_from_cam = torch.eye(4), torch.eye(4)
    world_from_cam[2, 3] = 0.5
    world_from_prev_person, world_from_person = torch.eye(4)[None], torch.eye(4)[None]
    world_from_prev_person = world_from_prev_person.clone()
    world_from_prev_person[0, 0, 3] = -1.0

    # The current frame: a wall 6 m away, and the person (instance 1) in the two middle columns.
    depth, instance = torch.full((1, 6, 8), 6.0), torch.zeros(1, 6, 8, dtype=torch.uint8)
    depth[..., 3:5], instance[..., 3:5] = 3.0, 1

    motions = instance_motion(
        world_from_prev_cam, world_from_cam, world_from_prev_person, world_from_person
    )
    raw = rigid_flow(depth, instance, K, motions)  # with a mask of known flow
    ego, obj, valid = factorize(raw, depth, K, motions[0])  # row 0 is the camera's own motion

    assert valid.all()
    print("u of the middle row, px")
    for name, flow in {"raw": raw.flow, "ego": ego, "obj": obj}.items():
        print(name, " ".join(f"{u:+.2f}" for u in flow[0, 2].tolist()))


if __name__ == "__main__":
    main()
