"""Conventions of simulators, by name: `sensors_from("isaac_lab", ...)` returns the adapters.

`CONVENTIONS` is the table. Each row names the sources of its facts, and where they are tested on
the simulator itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import CatTensors, Transform

from flowrep.transforms.adapt import AdaptDepth, AdaptFlow, AdaptPose
from flowrep.transforms.base import Keys, MapTransform, Reads, signed
from flowrep.transforms.flow import Intrinsics
from flowrep.transforms.maps import InstanceIds
from flowrep.transforms.motion import CameraMotion, InstanceMotion

MapLayout: TypeAlias = Literal["hw", "hwc"]

_PARTS = "adapted"  # only the next adapter reads the keys under it


@dataclass(frozen=True, kw_only=True)
class Convention:
    """The names of a simulator's buffers, and the options of the adapters that convert them.

    If an option's value is the name of an argument of `sensors_from`, the argument replaces it.

    Args:
        simulator: its name, and the version that has this convention.
        sources: documentation or code of the simulator that states the convention.
        tested_in: the file that tests it on the simulator; empty if it is only tested on buffers
            that were written as the sources say.
        layout: of maps, `"hw"` or `"hwc"`.
        ids_layout: of ids, if it differs; of several channels, the first is read.
        depth: options of `AdaptDepth` for each depth buffer, the usual buffer first.
        pose: buffers of the camera's pose: one, or position and quaternion.
        pose_options: of the camera's `AdaptPose`.
        bodies: buffers of the bodies' poses.
        bodies_options: of the bodies' `AdaptPose`.
        ids: buffer of instance ids.
        background: ids of pixels that show no body.
        flow: buffer of the simulator's flow; empty if it has none or the convention is unknown.
        flow_options: of `AdaptFlow`.
        K: how to get K.
        notes: what else a user has to know.
    """

    simulator: str
    sources: tuple[str, ...]
    tested_in: str = ""
    layout: MapLayout = "hw"
    ids_layout: MapLayout | None = None
    depth: Mapping[str, Mapping[str, Any]]
    pose: tuple[str, ...]
    pose_options: Mapping[str, Any]
    bodies: tuple[str, ...]
    bodies_options: Mapping[str, Any] = field(default_factory=dict)
    ids: str
    background: tuple[int, ...] = (0,)
    flow: str = ""
    flow_options: Mapping[str, Any] = field(default_factory=dict)
    K: str
    notes: str = ""


_ISAAC_DEPTH = {
    "distance_to_image_plane": {"kind": "z", "sky": 0.0},
    "depth": {"kind": "z", "sky": 0.0},
    "distance_to_camera": {"kind": "ray_length", "sky": 0.0, "intrinsics": "intrinsics"},
}
_ISAAC_3 = Convention(
    simulator="Isaac Lab 3.0",
    sources=(
        "isaac-sim.github.io/IsaacLab/release/3.0.0: Migrating To 3.0; Camera; "
        "isaaclab.sensors.camera.camera_data",
        "Omniverse Replicator, Annotators Information: Motion Vectors",
    ),
    layout="hwc",
    depth=_ISAAC_DEPTH,
    pose=("pos_w", "quat_w_ros"),
    pose_options={"layout": "xyz_xyzw", "axes": "opencv"},
    bodies=("body_link_pose_w",),
    bodies_options={"layout": "xyz_xyzw"},
    ids="instance_id_segmentation_fast",
    background=(0, 1),
    flow="motion_vectors",
    flow_options={"direction": "backward", "grid": "current"},
    K="intrinsic_matrices, pixel centres at halves",
    notes="Quaternions are (x, y, z, w). Buffers are ProxyArrays: pass their `.torch`. The "
    "camera's pose stays that of the start unless its config has update_latest_camera_pose=True. "
    "Only the RTX renderers give motion vectors, Newton's Warp renderer doesn't. Ids differ "
    "between environments, so bodies' motions need a batch of one environment.",
)

CONVENTIONS: dict[str, Convention] = {
    "isaac_lab": _ISAAC_3,
    "isaac_lab_2": replace(
        _ISAAC_3,
        simulator="Isaac Lab 2.3",
        sources=(
            "isaac-sim.github.io/IsaacLab/v2.3.2: isaaclab.sensors.camera.camera_data; "
            "isaaclab.sensors.camera.tiled_camera",
            "Omniverse Replicator, Annotators Information: Motion Vectors",
        ),
        pose_options={"layout": "xyz_wxyz", "axes": "opencv"},
        bodies_options={"layout": "xyz_wxyz"},
        notes="Quaternions are (w, x, y, z). A TiledCamera's pose stays that of the start unless "
        "its config has update_latest_camera_pose=True (return_latest_camera_pose before 2.1).",
    ),
    "maniskill": Convention(
        simulator="ManiSkill 3.0.1",
        sources=("mani_skill.render.shaders; mani_skill.sensors.camera",),
        tested_in="examples/maniskill_flow.py",
        layout="hwc",
        depth={"depth": {"kind": "z", "scale_m": 1e-3, "sky": 0.0}},
        pose=("cam2world_gl",),
        pose_options={"axes": "opengl"},
        bodies=("body_poses",),
        ids="segmentation",
        K="intrinsic_cv, pixel centres at halves",
        notes="Depth is int16 millimetres: what is farther than 32.7 m wraps round and counts as "
        "sky. ManiSkillEnv of the example collects the buffers and the poses of "
        "segmentation_id_map.",
    ),
    "mujoco": Convention(
        simulator="MuJoCo 3.17",
        sources=("mujoco.readthedocs.io: Python, Renderer; XML reference, body/camera",),
        tested_in="examples/mujoco_flow.py",
        ids_layout="hwc",
        depth={"depth": {"kind": "z", "sky": "far_m"}},
        pose=("camera_pose",),
        pose_options={"axes": "opengl"},
        bodies=("xpos", "xquat"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="segmentation",
        background=(),
        K="intrinsics_from_fov(fovy), with <quality offsamples='0'/>",
        notes="Ids are those of geoms: body_ids lists geoms, and xpos and xquat need a row for "
        "each, data.xpos[model.geom_bodyid[geoms]]. Where nothing is drawn, depth is the far "
        "plane, model.vis.map.zfar * model.stat.extent. The camera's pose is cam_xmat with "
        "cam_xpos. Call mj_forward before reading poses.",
    ),
    "mjlab": Convention(
        simulator="mjlab 1.6 (MuJoCo Warp 4.0)",
        sources=("mjlab.sensor.camera_sensor; mujoco_warp._src.render",),
        tested_in="examples/mjlab_flow.py, on a CPU",
        layout="hwc",
        depth={"depth": {"kind": "z", "sky": 0.0}},
        pose=("camera_pose",),
        pose_options={"axes": "opengl"},
        bodies=("xpos", "xquat"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="segmentation",
        background=(),
        K="intrinsics_from_fov(fovy)",
        notes="As MuJoCo, but depth is 0 where nothing is hit. If a camera has sensorsize, its K "
        "follows from focal lengths and sensor, cropped to the picture's aspect ratio. "
        "TorchRL's MJLabWrapper passes on only RGB; the rest needs a group of observations.",
    ),
    "newton": Convention(
        simulator="Newton 1.8",
        sources=("newton.sensors.SensorCamera; newton.State.body_q",),
        tested_in="examples/newton_flow.py, on a CPU",
        depth={
            "forward_depth": {"kind": "z", "sky": 0.0},
            "depth": {"kind": "ray_length", "sky": 0.0, "intrinsics": "intrinsics"},
        },
        pose=("camera_transforms",),
        pose_options={"layout": "xyz_xyzw", "axes": "opengl"},
        bodies=("body_q",),
        bodies_options={"layout": "xyz_xyzw"},
        ids="shape_index",
        background=(0xFFFFFFFF,),
        K="intrinsics_from_fov(camera_fov), pixel centres at halves",
        notes="Ids are those of shapes: body_ids lists shapes, and body_q needs a row for each, "
        "state.body_q[model.shape_body[shapes]]. Shapes are numbered across all worlds. Where "
        "nothing is hit, depth is 0, clear_data.clear_depth; SensorTiledCamera documents a "
        "negative value.",
    ),
    "genesis": Convention(
        simulator="Genesis 1.4.5",
        sources=("genesis.vis.camera.Camera: render, transform, intrinsics",),
        tested_in="tests/transforms/test_conventions.py, on a CPU",
        depth={"depth": {"kind": "z", "sky": "far_m"}},
        pose=("transform",),
        pose_options={"axes": "opengl"},
        bodies=("links_pos", "links_quat"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="segmentation",
        K="camera.intrinsics",
        notes="far_m is the camera's far. Ids are indices of scene.segmentation_idx_dict, at "
        "VisOptions(segmentation_level='link') one per link. If a driver multisamples depth, it "
        "is a mixture at edges. TorchRL's GenesisWrapper doesn't reset the scene.",
    ),
    "habitat": Convention(
        simulator="Habitat-Sim 0.3.3",
        sources=("habitat_sim: gfx_batch/DepthUnprojection, agent.SixDOFPose, CameraSensorSpec",),
        depth={"depth_sensor": {"kind": "z", "sky": 0.0}},
        pose=("position", "rotation"),
        pose_options={"layout": "xyz_wxyz", "axes": "opengl"},
        bodies=("object_position", "object_rotation"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="semantic_sensor",
        K="intrinsics_from_fov(hfov, axis='horizontal')",
        notes="Take the sensor's pose, agent.get_state().sensor_states[name], not the agent's. "
        "quaternion.as_float_array gives (w, x, y, z); an object's rotation is a Magnum "
        "quaternion, scalar and vector.",
    ),
    "kubric": Convention(
        simulator="Kubric (0ee21e2, MOVi)",
        sources=("kubric: challenges/movi/README.md; renderer/blender_utils.py; core/cameras.py",),
        layout="hwc",
        depth={
            "depth": {"kind": "ray_length", "sky": 1e10, "intrinsics": "intrinsics"},
            "z": {"kind": "z", "sky": 1e10},
        },
        pose=("positions", "quaternions"),
        pose_options={"layout": "xyz_wxyz", "axes": "opengl"},
        bodies=("instance_positions", "instance_quaternions"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="segmentations",
        flow="backward_flow",
        flow_options={"direction": "backward", "grid": "current", "channels": "row_column"},
        K="focal_length / sensor_width * width",
        notes="forward_flow lies on the frame it starts from: swap the frames' roles to use it. "
        "MOVi's flow of 16 bits has to be scaled back by its range first. Segmentation is an "
        "instance's index + 1.",
    ),
    "ai2thor": Convention(
        simulator="AI2-THOR 5",
        sources=("ai2thor.allenai.org: Environment State; ai2thor.server.Event",),
        depth={"depth_frame": {"kind": "z", "sky": "far_m"}},
        pose=("camera_pose",),
        pose_options={"axes": "unity"},
        bodies=("object_poses",),
        bodies_options={"axes": "unity"},
        ids="instance_ids",
        K="intrinsics_from_fov(fieldOfView)",
        notes="Unity's world is left-handed, with y up: poses are 4 x 4 matrices in it. far_m is "
        "the camera's far plane, 20 m by default. Ids are colours: number them, by "
        "event.object_id_to_color. renderFlowImage isn't documented.",
    ),
    "carla": Convention(
        simulator="CARLA 0.9.16",
        sources=("carla.readthedocs.io/en/0.9.16: Sensors reference; carla.Transform.get_matrix",),
        depth={"depth": {"kind": "z", "scale_m": 1000.0 / (256**3 - 1), "sky": 256**3 - 1}},
        pose=("transform",),
        pose_options={"axes": "unreal"},
        bodies=("actor_transforms",),
        bodies_options={"axes": "unreal"},
        ids="instance",
        K="intrinsics_from_fov(fov, axis='horizontal')",
        notes="Depth is R + 256 G + 65536 B, as int32, and an id G + 256 B of the instance camera; "
        "raw_data is BGRA. Poses are transform.get_matrix(). Set lens_circle_multiplier and lens_k "
        "so that no lens distorts. The optical flow camera's direction and step aren't documented "
        "(carla #4795): check it before use.",
    ),
    "airsim": Convention(
        simulator="Cosys-AirSim 3.3",
        sources=("Cosys-AirSim: docs/image_apis.md; docs/apis.md, Coordinate system",),
        depth={
            "DepthPlanar": {"kind": "z", "sky": "far_m"},
            "DepthPerspective": {"kind": "ray_length", "sky": "far_m", "intrinsics": "intrinsics"},
        },
        pose=("camera_position", "camera_orientation"),
        pose_options={"layout": "xyz_wxyz", "axes": "ned"},
        bodies=("object_positions", "object_orientations"),
        bodies_options={"layout": "xyz_wxyz"},
        ids="segmentation",
        K="intrinsics_from_fov(fov, axis='horizontal')",
        notes="far_m is the depth of a pixel of the sky in your world, such as 65504. Ids are "
        "colours: pack them, R + 256 G + 65536 B, by simGetSegmentationColorMap. OpticalFlow is "
        "only that of the camera's motion, and its unit isn't documented.",
    ),
    "pybullet": Convention(
        simulator="PyBullet 3.2.7",
        sources=("PyBullet Quickstart Guide: getCameraImage, computeViewMatrix",),
        tested_in="tests/transforms/test_conventions.py",
        depth={"depth": {"kind": "z_buffer", "near_m": "near_m", "far_m": "far_m"}},
        pose=("view",),
        pose_options={"direction": "world_to_camera", "axes": "opengl"},
        bodies=("positions", "orientations"),
        bodies_options={"layout": "xyz_xyzw"},
        ids="segmentation",
        background=(),
        K="flowrep.pybullet.BulletCamera.K; the software renderer's is centred + (0.5, -0.5)",
        notes="flowrep.pybullet.BulletCamera does all this, links and bodies that come and go "
        "included. The view is np.reshape(viewMatrix, (4, 4)).T. Ids of links are "
        "body + ((link + 1) << 24), and a link's pose is getLinkState's with "
        "computeForwardKinematics=1; without that, it is a substep old.",
    ),
}


def sensors_from(
    simulator: str,
    *,
    depth: str | None = None,
    body_ids: Sequence[Any] | None = None,
    static_ids: Sequence[int] = (),
    flow: bool = False,
    intrinsics: Intrinsics | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    prefix: NestedKey = (),
    keys: Mapping[str, NestedKey] | None = None,
) -> list[Transform]:
    """Returns the adapters from a simulator's buffers to the sensor keys of `RawFlow` and others.

    They write `("sensor", "depth")`, `"world_from_cam"` and `"prev_from_curr"`; with `body_ids`,
    `"world_from_body"`, `"instance"` and `"instance_motion"` too; with `flow`, `"raw"`. Buffers are
    read under the names that `CONVENTIONS[simulator]` lists, beneath `prefix`. A second camera
    needs the adapters themselves, with other `out_keys`.

    Args:
        simulator: a key of `CONVENTIONS`.
        depth: which of its depth buffers; by default the first.
        body_ids: ids in the order of the rows of the bodies' poses; the convention's notes say what
            they identify. Leave them out if the world is static or flow is measured.
        static_ids: ids of bodies that stand still and need no pose.
        flow: whether to read the simulator's flow, if it has any whose convention is known.
        intrinsics: K `[3, 3]` or its key, for depth along the rays.
        near_m: the near plane, for depth from a z-buffer.
        far_m: the far plane, for depth from a z-buffer, or the depth that stands for the sky.
        prefix: the key under which all buffers are nested.
        keys: the keys of buffers that are elsewhere, by the buffers' names.

    Raises:
        ValueError: a name is unknown, an argument that the simulator needs is missing, or one is
            given that it doesn't need.

    Example:
        >>> from torchrl.envs import Compose
        >>> from flowrep.transforms import FlowFactorize, RawFlow
        >>> K = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]
        >>> sensors = sensors_from("mujoco", body_ids=[3, 4], far_m=20.0, prefix="camera")
        >>> _ = Compose(*sensors, RawFlow(K), FlowFactorize(K))
        >>> sensors[-2]
        InstanceIds([('adapted', 'segmentation')] -> [('sensor', 'instance')])
    """
    if simulator not in CONVENTIONS:
        raise ValueError(f"unknown simulator {simulator!r}; known are {', '.join(CONVENTIONS)}")
    row = CONVENTIONS[simulator]
    if static_ids and body_ids is None:
        raise ValueError("static_ids needs body_ids, the ids of the bodies that move")
    chosen = next(iter(row.depth)) if depth is None else depth
    if chosen not in row.depth:
        raise ValueError(f"{row.simulator} has no depth {chosen!r}; it has {', '.join(row.depth)}")
    if flow and not row.flow:
        raise ValueError(f"{row.simulator} has no flow whose convention is known: {row.notes}")
    arguments: dict[str, Any] = {"intrinsics": intrinsics, "near_m": near_m, "far_m": far_m}
    options: dict[str, Any] = {}
    for name, value in row.depth[chosen].items():
        options[name] = arguments.get(value, value)
    for name, value in arguments.items():
        if (name in row.depth[chosen].values()) != (value is not None):
            verb = "needs" if value is None else "doesn't read"
            raise ValueError(f"{row.simulator}'s {chosen} {verb} {name}=; {row.notes}")

    elsewhere = dict(keys or {})
    root = (prefix,) if isinstance(prefix, str) else tuple(prefix)

    def key(name: str) -> NestedKey:
        return elsewhere.pop(name, (*root, name) if root else name)

    def plane(name: str, layout: MapLayout) -> Transform:
        return Plane(layout, in_keys=key(name), out_keys=(_PARTS, name))

    def poses(
        names: tuple[str, ...], options: Mapping[str, Any], written: NestedKey
    ) -> list[Transform]:
        if len(names) == 1:
            return [AdaptPose(**options, in_keys=key(names[0]), out_keys=written)]
        joined: NestedKey = (_PARTS, written[-1])
        parts = CatTensors(
            [key(name) for name in names], joined, dim=-1, del_keys=False, sort=False
        )
        return [parts, AdaptPose(**options, in_keys=joined, out_keys=written)]

    adapters = [plane(chosen, row.layout), AdaptDepth(**options, in_keys=(_PARTS, chosen))]
    adapters += [*poses(row.pose, row.pose_options, ("sensor", "world_from_cam")), CameraMotion()]
    if body_ids is not None:
        adapters += poses(row.bodies, row.bodies_options, ("sensor", "world_from_body"))
        static = [*row.background, *static_ids]
        adapters += [
            plane(row.ids, row.ids_layout or row.layout),
            InstanceIds(body_ids, static_ids=static, in_keys=(_PARTS, row.ids)),
            InstanceMotion(),
        ]
    if flow:
        is_last = row.layout == "hwc"
        adapters.append(AdaptFlow(**row.flow_options, channels_last=is_last, in_keys=key(row.flow)))
    if elsewhere:
        names = sorted(elsewhere)
        raise ValueError(f"keys= names {names}, which {row.simulator} doesn't read here")
    return adapters


class Plane(MapTransform):
    """A picture's first channel, as a map `[*B, 1, H, W]`.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `[*B, H, W]` or `[*B, H, W, C]` | one key | `[*B, 1, H, W]` | as read | |

    Unsigned integers of 16 bits and more become int64, as PyTorch hardly computes with them.

    Args:
        layout: `"hw"` or `"hwc"`.
    """

    def __init__(self, layout: MapLayout, *, in_keys: Keys, out_keys: Keys) -> None:
        shape = ("H", "W") if layout == "hw" else ("H", "W", "C")
        super().__init__([Reads(shape)], in_keys, out_keys)

    def compute(self, picture: Tensor) -> tuple[Tensor]:
        """Returns the map."""
        if len(self.reads[0].shape) == 3:
            picture = picture[..., 0]
        return (picture.to(signed(picture.dtype)).unsqueeze(-3),)

    def output_specs(self, picture: TensorSpec) -> tuple[TensorSpec]:
        """Returns an unbounded spec."""
        *batch, height, width = picture.shape[: picture.ndim - (len(self.reads[0].shape) == 3)]
        shape = (*batch, 1, height, width)
        return (Unbounded(shape, device=picture.device, dtype=signed(picture.dtype)),)
