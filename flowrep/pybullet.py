"""The sensor keys of any PyBullet world: `BulletCamera`, and `BulletFlow` for gymnasium envs."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

from flowrep.extras import require

require("flowrep.pybullet", "sim", "pybullet", "gymnasium")

import gymnasium as gym
import numpy as np
import pybullet
from gymnasium import spaces
from numpy.typing import NDArray

from flowrep.simulator.motion import instance_motion, rigid_inverse

Array: TypeAlias = NDArray[Any]
View: TypeAlias = Sequence[float]

_TAG = "flowrep"
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera has y up and z backward
_RIGID, _SOFT = 1, 3  # what getDynamicsInfo returns as a body's type has no names in PyBullet


class BulletCamera:
    """A camera in a PyBullet world: its maps, and the motions of the camera and of all bodies.

    Each call takes one picture and returns the sensor keys as numpy arrays, ready for
    `TensorDict(sensor=camera())`. Call it once per step, and call `reset` at the first frame of an
    episode.

    | key | shape | |
    | --- | --- | --- |
    | `depth` | float32 `[1, H, W]` | metres along z, `inf` where nothing was drawn |
    | `instance` | uint8 or int16 `[1, H, W]` | the row of `instance_motion`, 0 for the sky |
    | `prev_from_curr` | float32 `[4, 4]` | the camera's motion since the last call |
    | `instance_motion` | float32 `[1 + max_instances, 4, 4]` | the same for each body or link |
    | `semantic`, with `classes` | uint8 `[1, H, W]` | |
    | `rgb`, with `rgb=True` | uint8 `[3, H, W]` | |

    A body keeps its row in an episode while it exists. The motion of a body that didn't exist at
    the last call is nan, like that of a soft body, so that its flow is unknown. The poses of links
    are those at which they are drawn: `getLinkState` lags one substep behind, and with
    `computeForwardKinematics` it would change what the env reads next. Each body is marked once
    with PyBullet's `addUserData`, to distinguish it from another body that gets its number later;
    nothing else in the world changes.

    Args:
        client: a `BulletClient`, the number of a client, or the module `pybullet`.
        width: pixels.
        height: pixels.
        fov_deg: vertical field of view, as in `computeProjectionMatrixFOV`.
        projection: instead, the 16 numbers of a perspective `computeProjectionMatrix`.
        near_m: with `fov_deg`, the near plane, by default 0.05.
        far_m: with `fov_deg`, the far plane, beyond which nothing is drawn, by default 100.
        view: the 16 numbers of `computeViewMatrix`, or a function that returns them at each call.
            Without it, each call needs a view.
        link: (body, link) on which the camera is mounted, link -1 for the base. `view` is then in
            the axes of the URDF's link; without it, the camera looks along z, and y is down.
        max_instances: the number of rows for bodies and links that exist at the same time.
        classes: class ids by body; other bodies, and the sky, are 0.
        rgb: whether to return the picture.
        renderer: PyBullet's constant. Without EGL's plugin or a window, PyBullet uses the software
            renderer whatever you choose. K is that of the renderer in use.
        picture: further arguments of `getCameraImage`, such as `lightDirection` or `shadow`.

    Attributes:
        K: `[3, 3]`, pixels, such that unprojected depth lies on the surfaces.
        rows: rows of `instance_motion` by (body, link); a body's base is link -1.

    Raises:
        ValueError: arguments don't fit together, the world has more than `max_instances` bodies and
            links, or `link` doesn't exist or has no known pose.

    Example:
        >>> client = pybullet.connect(pybullet.DIRECT)
        >>> ball = pybullet.createVisualShape(pybullet.GEOM_SPHERE, 0.5, physicsClientId=client)
        >>> ball = pybullet.createMultiBody(0, -1, ball, [0, 0, 2], physicsClientId=client)
        >>> view = pybullet.computeViewMatrix([0, -3, 2], [0, 0, 2], [0, 0, 1])
        >>> camera = BulletCamera(client, 60, 40, fov_deg=60, view=view)
        >>> print(camera.reset()["depth"][0, 20, 30].round(1))
        2.5
        >>> pybullet.resetBasePositionAndOrientation(ball, [0.25, 0, 2], [0, 0, 0, 1], client)
        >>> camera()["instance_motion"][camera.rows[ball, -1], :3, 3]  # it was 25 cm to the left
        array([-0.25,  0.  ,  0.  ], dtype=float32)
        >>> pybullet.disconnect(client)
    """

    def __init__(
        self,
        client: Any,
        width: int,
        height: int,
        *,
        fov_deg: float | None = None,
        projection: View | None = None,
        near_m: float | None = None,
        far_m: float | None = None,
        view: View | Callable[[], View] | None = None,
        link: tuple[int, int] | None = None,
        max_instances: int = 64,
        classes: Mapping[int, int] | None = None,
        rgb: bool = False,
        renderer: int = pybullet.ER_TINY_RENDERER,
        **picture: Any,
    ) -> None:
        if not 1 <= max_instances < 1 << 15:
            raise ValueError(f"max_instances must be 1 to {(1 << 15) - 1}, got {max_instances}")
        if min(width, height) < 1:
            raise ValueError(f"width and height must be at least 1, got {width} and {height}")
        if taken := {"physicsClientId", "projectionMatrix", "viewMatrix"} & picture.keys():
            raise ValueError(f"give client, projection or view instead of {', '.join(taken)}")
        for body, of in (classes or {}).items():
            if not hasattr(body, "__index__") or of not in range(256):
                raise ValueError(
                    f"classes are ids, 0 to 255, by the number of a body; got {body!r}: {of!r}"
                )
        if picture.get("flags", 0) & pybullet.ER_NO_SEGMENTATION_MASK:
            raise ValueError("without a segmentation mask (ER_NO_SEGMENTATION_MASK), no instances")
        self._client = _Client(int(client)) if isinstance(client, int | np.integer) else client
        self.width, self.height = width, height
        if projection is None:
            near_m, far_m = 0.05 if near_m is None else near_m, 100.0 if far_m is None else far_m
            if fov_deg is None or not (0 < fov_deg < 180 and 0 < near_m < far_m):
                raise ValueError(
                    "give fov_deg between 0 and 180, with 0 < near_m < far_m, or projection; got "
                    f"fov_deg={fov_deg}, near_m={near_m}, far_m={far_m}"
                )
            projection = pybullet.computeProjectionMatrixFOV(fov_deg, width / height, near_m, far_m)
        elif (fov_deg, near_m, far_m) != (None, None, None):
            raise ValueError("give projection, or fov_deg, near_m and far_m; not both")
        self._picture = {"shadow": 0, "renderer": renderer} | picture
        # PyBullet ignores matrices that aren't flat lists, and draws with the last ones.
        self._picture["projectionMatrix"] = np.ravel(projection).tolist()
        flags = pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
        self._picture["flags"] = self._picture.get("flags", 0) | flags
        self.K, self._range_m = self._intrinsics(np.array(projection, dtype=np.float32))
        self._view, self._link = view, link
        self.max_instances, self._classes, self._has_rgb = max_instances, classes, rgb
        self._instance_type = np.uint8 if max_instances < 256 else np.int16
        self.rows: dict[tuple[int, int], int] = {}
        self._bodies: dict[str, _Body] = {}  # by tag
        self._before: tuple[Array, Array] | None = None  # poses of the camera and by row
        self._row_of: dict[tuple[str, int], int] = {}  # by tag and link

    def reset(self, view: View | None = None) -> dict[str, Array]:
        """Returns the sensor keys of an episode's first frame, at which nothing has moved."""
        self._before, self._row_of = None, {}
        return self(view)

    def __call__(self, view: View | None = None) -> dict[str, Array]:
        """Returns the sensor keys of this step.

        Args:
            view: the camera's current view, instead of the constructor's.
        """
        bodies = self._existing()
        poses = {tag: body.poses(self._client) for tag, body in bodies.items()}  # [1 + links, 4, 4]
        world_from_cam = self._pose(view, bodies, poses)
        row_of = self._rows(poses)
        self.rows = {(bodies[tag].number, link): row for (tag, link), row in row_of.items()}
        now = np.full((self.max_instances, 4, 4), np.nan)
        for tag, pose in poses.items():
            now[[row_of[tag, link - 1] - 1 for link in range(len(pose))]] = pose
        camera_before, before = self._before or (world_from_cam, now)
        motion = instance_motion(camera_before, world_from_cam, before, now)
        absent = np.ones(1 + self.max_instances, dtype=bool)
        absent[list(row_of.values())] = False
        motion[absent] = motion[0]
        self._before, self._row_of = (world_from_cam, now), row_of
        motions = motion.astype(np.float32)
        maps = self._look(world_from_cam)
        return maps | {"prev_from_curr": motions[0].copy(), "instance_motion": motions}

    def space(self) -> spaces.Dict:
        """Returns the space of the sensor keys, for gymnasium."""
        size, anything = (1, self.height, self.width), (-np.inf, np.inf)
        maps: dict[str, spaces.Space] = {
            "depth": spaces.Box(0.0, np.inf, size, np.float32),
            "instance": spaces.Box(0, self.max_instances, size, self._instance_type),
            "prev_from_curr": spaces.Box(*anything, (4, 4), np.float32),
            "instance_motion": spaces.Box(*anything, (1 + self.max_instances, 4, 4), np.float32),
        }
        if self._classes is not None:
            most = max(self._classes.values(), default=0)
            maps["semantic"] = spaces.Box(0, most, size, np.uint8)
        if self._has_rgb:
            maps["rgb"] = spaces.Box(0, 255, (3, *size[1:]), np.uint8)
        return spaces.Dict(maps)

    def _intrinsics(self, projection: Array) -> tuple[Array, tuple[float, float]]:
        """Returns K and the near and far plane of a projection, float32 as PyBullet reads it."""
        matrix = projection.reshape(4, 4).T
        free = np.array([[1, 0, 1, 0], [0, 1, 1, 0], [0, 0, 1, 1], [0, 0, 1, 0]], dtype=bool)
        with np.errstate(divide="ignore", invalid="ignore"):
            near_m = matrix[2, 3] / (matrix[2, 2] - 1)
            far_m = matrix[2, 3] / (matrix[2, 2] + 1)
        if matrix[~free].any() or matrix[3, 2] != -1 or not 0 < near_m < far_m:
            raise ValueError(
                "projection must be that of a perspective camera, as computeProjectionMatrixFOV "
                "and computeProjectionMatrix return it, with the far plane less than 1e7 times as "
                f"far as the near plane; got {projection.tolist()}"
            )
        half = self.width / 2, self.height / 2
        fx, fy = half[0] * float(matrix[0, 0]), half[1] * float(matrix[1, 1])
        K = np.array([[fx, 0.0, half[0]], [0.0, fy, half[1]], [0.0, 0.0, 1.0]])
        if _software_draws(self._client, self._picture["renderer"]):
            # It samples pixel (column i, row j), whose centre is (i + 0.5, j + 0.5), at (i, j + 1).
            K[:2, 2] += 0.5, -0.5
        K[:2, 2] += half[0] * -float(matrix[0, 2]), half[1] * float(matrix[1, 2])  # off-centre
        return K, (float(near_m), float(far_m))

    def _existing(self) -> dict[str, _Body]:
        """Returns the bodies that exist now, by the tag that a body keeps while it exists."""
        client, bodies = self._client, {}
        for number in map(client.getBodyUniqueId, range(client.getNumBodies())):
            key = client.getUserDataId(number, _TAG)
            if key < 0:  # a new body, perhaps with the number of a removed one
                key = client.addUserData(number, _TAG, uuid.uuid4().hex)
            tag = client.getUserData(key).decode()
            bodies[tag] = self._bodies.get(tag) or _Body(client, number)
        self._bodies = bodies
        return bodies

    def _rows(self, poses: Mapping[str, Array]) -> dict[tuple[str, int], int]:
        """Returns the row of each instance: the same as before, or a free one if it is new."""
        present = [(tag, link - 1) for tag, pose in poses.items() for link in range(len(pose))]
        # When an instance disappears, its row stays empty for a step, so that a row never has one
        # body in this frame and another in the previous frame.
        taken = set(self._row_of.values())
        free = (row for row in range(1, 1 + self.max_instances) if row not in taken)
        row_of = {each: self._row_of.get(each) or next(free, 0) for each in present}
        if without := sum(row == 0 for row in row_of.values()):
            raise ValueError(
                f"the world has {len(present)} bodies and links, and "
                f"{len(taken - set(row_of.values()))} have just left: give max_instances="
                f"{self.max_instances + without} or more"
            )
        return row_of

    def _pose(
        self, view: View | None, bodies: Mapping[str, _Body], poses: Mapping[str, Array]
    ) -> Array:
        """Returns world_from_cam [4, 4]."""
        if view is None:
            view = self._view() if callable(self._view) else self._view
        if self._link is None:
            if view is None:
                raise ValueError("the camera has no view: give one to BulletCamera or to each call")
            return _pose_of_view(view)
        body, link = self._link
        for tag, each in bodies.items():
            if each.number == body and -1 <= link < len(each.parents):
                world_from_link = poses[tag][1 + link] @ each.mass_from_link[1 + link]
                if np.isnan(world_from_link).any():
                    raise ValueError(
                        f"the pose of link {link} of body {body} is unknown: it diverged, is soft, "
                        "behind a planar joint, or was loaded with useMaximalCoordinates"
                    )
                return world_from_link if view is None else world_from_link @ _pose_of_view(view)
        raise ValueError(
            f"no body {body} with a link {link}; there are "
            f"{ {each.number: f'{len(each.parents)} links' for each in bodies.values()} }"
        )

    def _look(self, world_from_cam: Array) -> dict[str, Array]:
        view = (_GL_FROM_CV @ rigid_inverse(world_from_cam)).T.ravel().tolist()
        _, _, rgba, zbuffer, ids = self._client.getCameraImage(
            self.width, self.height, view, **self._picture
        )
        shape = self.height, self.width  # PyBullet returns tuples if it was built without numpy
        ids = np.asarray(ids, dtype=np.int32).reshape(shape)
        zbuffer = np.asarray(zbuffer, dtype=np.float32).reshape(shape)
        # The z-buffer of the sky is close to 1, above or below, but seldom 1.
        is_sky = ids == -1
        depth = _depth_from_zbuffer(zbuffer, *self._range_m)
        depth[is_sky] = np.inf
        # Ids are body + ((link + 1) << 24); the sky's -1 would be body 0xffffff, link 254.
        packed = np.where(is_sky, 0, ids).view(np.uint32)
        body, link = packed & 0xFFFFFF, packed >> 24
        table = np.full((1 + int(body.max()), 1 + int(link.max())), -1)  # of rows; link 0: the base
        for (of, joined), row in self.rows.items():
            if of < len(table) and 1 + joined < table.shape[1]:
                table[of, 1 + joined] = row
        instance = table[body, link]
        instance[is_sky] = 0
        if (instance < 0).any():
            unknown = sorted({int(number) for number in body[instance < 0]})
            raise RuntimeError(
                f"the picture shows bodies {unknown}, or links of them, that this client doesn't "
                "list: another process or batchPositions added them; call its syncBodyInfo()"
            )
        maps = {"depth": depth[None], "instance": instance[None].astype(self._instance_type)}
        if self._classes is not None:
            numbers = range(int(body.max()) + 1)
            class_of = np.array([self._classes.get(n, 0) for n in numbers], dtype=np.uint8)
            maps["semantic"] = np.where(is_sky, np.uint8(0), class_of[body])[None]
        if self._has_rgb:
            colours = np.asarray(rgba, dtype=np.uint8).reshape(*shape, 4)[..., :3]
            maps["rgb"] = np.ascontiguousarray(colours.transpose(2, 0, 1))
        return maps


class BulletFlow(gym.Wrapper):
    """Adds a camera's sensor keys to the observations of a gymnasium env on PyBullet.

    They are under `"sensor"`, next to the entries of a dict of observations, or next to
    `"observation"` if the env returns an array. At a reset nothing has moved.

    Args:
        env: an env on PyBullet.
        camera: a function that takes `env.unwrapped` and returns its `BulletCamera`. It is called
            after each reset, because some envs connect or load their robot again at a reset, and
            once in the constructor, after a reset. If the env keeps its world, it may also be a
            `BulletCamera`.

    Raises:
        ValueError: the env observes `"sensor"` already; at a reset, the camera has another K.

    Attributes:
        camera: the `BulletCamera`.
        K: its K `[3, 3]`; through further wrappers, `env.get_wrapper_attr("K")`.

    Example:
        >>> import panda_gym  # doctest: +SKIP
        >>> from torchrl.envs import Compose, GymWrapper, TransformedEnv
        >>> from flowrep.transforms import FlowFactorize, RawFlow
        >>> view = pybullet.computeViewMatrix([0.7, 0.5, 0.6], [0, 0, 0.1], [0, 0, 1])
        >>> env = BulletFlow(  # doctest: +SKIP
        ...     gym.make("PandaReach-v3"),
        ...     lambda env: BulletCamera(env.sim.physics_client, 96, 64, fov_deg=60, view=view),
        ... )
        >>> flow = Compose(RawFlow(env.K), FlowFactorize(env.K))  # doctest: +SKIP
        >>> TransformedEnv(GymWrapper(env), flow).rollout(3)["obj"].shape  # doctest: +SKIP
        torch.Size([3, 2, 64, 96])
    """

    def __init__(self, env: gym.Env, camera: Callable[[Any], BulletCamera] | BulletCamera) -> None:
        super().__init__(env)
        if isinstance(camera, BulletCamera):
            self._make: Callable[[Any], BulletCamera] = lambda _: camera
        else:
            self._make = camera
            env.reset()
        self.camera = self._make(env.unwrapped)
        seen = env.observation_space
        entries = dict(seen.spaces) if isinstance(seen, spaces.Dict) else {"observation": seen}
        if "sensor" in entries:
            raise ValueError("the env's observations have a 'sensor' already; rename it first")
        self.observation_space = spaces.Dict(entries | {"sensor": self.camera.space()})

    @property
    def K(self) -> Array:
        """The camera's K `[3, 3]`, pixels."""
        return self.camera.K

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        before, self.camera = self.K, self._make(self.env.unwrapped)
        if not np.array_equal(self.K, before):
            raise ValueError(
                f"K was {before.tolist()} and is now {self.K.tolist()}: flow is computed with that "
                "of the first camera, so give all episodes one size and projection"
            )
        return self._beside(observation, self.camera.reset()), info

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Acts."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._beside(observation, self.camera()), reward, terminated, truncated, info

    def _beside(self, observation: Any, maps: dict[str, Array]) -> dict[str, Any]:
        entries = observation if isinstance(observation, dict) else {"observation": observation}
        return {**entries, "sensor": maps}


class _Client:
    """PyBullet's functions for a client that is given by its number."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(pybullet, name), physicsClientId=self._number)


class _Body:
    """A body: its constants, and the current poses of its base and links.

    Poses are those of the centres of mass, as `getBasePositionAndOrientation` returns them. Those
    of links follow from the joints' positions by forward kinematics, as Bullet draws them.
    """

    def __init__(self, client: Any, number: int) -> None:
        self.number = number
        base = client.getDynamicsInfo(number, -1)
        if base[10] == _RIGID and len(client.getVisualShapeData(number)) > 1:
            raise ValueError(
                f"body {number} has several shapes and useMaximalCoordinates: PyBullet draws the "
                "links of such a body under one id and doesn't report their poses; load it without"
            )
        self.is_soft = base[10] == _SOFT
        links = range(0 if self.is_soft else client.getNumJoints(number))
        infos = [client.getJointInfo(number, link) for link in links]
        states = [client.getLinkState(number, link) for link in links]
        self.parents = [info[16] for info in infos]
        self.types = np.array([info[2] for info in infos])
        self.joints = [link for link in links if infos[link][2] != pybullet.JOINT_FIXED]
        inertial = [base[3:5], *(state[2:4] for state in states)]
        self.mass_from_link = rigid_inverse(_transforms(*zip(*inertial)))
        if base[10] == _RIGID:
            self.mass_from_link[0] = np.nan  # PyBullet returns uninitialised memory
        # In Bullet, a joint is at the origin of its link. Its axis and frame have the axes of the
        # link's inertia, and its rotation leads from the parent to the link.
        turned = _transforms([(0.0, 0.0, 0.0)] * len(infos), [info[15] for info in infos])
        self.parent_from_joint = rigid_inverse(turned)
        self.parent_from_joint[:, :3, 3] = np.array([i[14] for i in infos]).reshape(-1, 3)
        self.joint_from_mass = np.tile(np.eye(4), (len(infos), 1, 1))
        self.joint_from_mass[:, :3, 3] = -self.mass_from_link[1:, :3, 3]
        self.axes = np.array([info[13] for info in infos], dtype=np.float64).reshape(-1, 3)
        # Axes may have any length, for instance (2, 1, 1) in MJCF. Bullet normalises it when it
        # turns, but slides by multiples of it.
        x, y, z = (self.axes / np.linalg.norm(self.axes, axis=1, keepdims=True).clip(1e-12)).T
        o = np.zeros_like(x)
        self.cross = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(-1, 3, 3)
        self.cross_twice = self.cross @ self.cross

    def poses(self, client: Any) -> Array:
        """Returns world_from_mass [1 + links, 4, 4], of the base first."""
        if self.is_soft:
            return np.full((1, 4, 4), np.nan)
        base = _transforms(*([part] for part in client.getBasePositionAndOrientation(self.number)))
        if not self.parents:
            return base
        local = self.parent_from_joint @ self._joints(client) @ self.joint_from_mass
        world = np.empty((1 + len(local), 4, 4))
        world[0] = base[0]
        for link, parent in enumerate(self.parents):
            world[1 + link] = world[1 + parent] @ local[link]
        return world

    def _joints(self, client: Any) -> Array:
        """Returns the transforms [links, 4, 4] of the joints' positions."""
        links = range(len(self.parents))
        position = np.array([state[0] for state in client.getJointStates(self.number, links)])
        angle = np.where(self.types == pybullet.JOINT_REVOLUTE, position, 0.0)[:, None, None]
        slide = np.where(self.types == pybullet.JOINT_PRISMATIC, position, 0.0)
        moved = np.zeros((len(links), 4, 4))
        turned = np.sin(angle) * self.cross + (1 - np.cos(angle)) * self.cross_twice
        moved[:, :3, :3] = np.eye(3) + turned  # Rodrigues
        moved[:, :3, 3] = slide[:, None] * self.axes
        moved[:, 3, 3] = 1.0
        for link in self.joints:
            if self.types[link] == pybullet.JOINT_SPHERICAL:
                quaternion = client.getJointStateMultiDof(self.number, link)[0]
                moved[link] = _transforms([(0.0, 0.0, 0.0)], [quaternion])[0]
            elif self.types[link] not in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC):
                moved[link] = np.nan  # another joint, such as a planar one: unknown flow
        return moved


def _pose_of_view(view: View) -> Array:
    """Returns world_from_cam [4, 4], with OpenCV's axes, of the 16 numbers of a view matrix."""
    numbers = np.asarray(view, dtype=np.float64)
    if numbers.size != 16:
        raise ValueError(f"a view has 16 numbers, column by column; got {numbers.size}")
    gl_from_world = numbers.reshape(4, 4).T
    if not abs(rigid_inverse(gl_from_world) @ gl_from_world - np.eye(4)).max() < 1e-3:
        raise ValueError(
            f"a view is a rotation and a translation, column by column; got {numbers.tolist()}"
        )
    return rigid_inverse(gl_from_world) @ _GL_FROM_CV


def _depth_from_zbuffer(zbuffer: Array, near_m: float, far_m: float) -> Array:
    """Returns depth along z in metres, float32, from OpenGL depth-buffer values in [0, 1]."""
    # The usual formula has far - (far - near) · z, which loses precision near z = 1. There, 1 - z
    # is exact in float32.
    gap = (np.float32(1.0) - zbuffer) * np.float32(far_m - near_m) + np.float32(near_m)
    return np.float32(far_m * near_m) / gap


def _transforms(positions: Sequence[View], quaternions_xyzw: Sequence[View]) -> Array:
    """Returns the transforms [N, 4, 4] of N positions and quaternions."""
    count = len(positions)
    transforms = np.tile(np.eye(4), (count, 1, 1))
    turns = [pybullet.getMatrixFromQuaternion(quaternion) for quaternion in quaternions_xyzw]
    transforms[:, :3, :3] = np.reshape(turns, (count, 3, 3))
    transforms[:, :3, 3] = np.reshape(positions, (count, 3))
    return transforms


def _software_draws(client: Any, renderer: int) -> bool:
    """Returns whether the software renderer draws this client's pictures.

    PyBullet doesn't say so, because EGL's plugin replaces that renderer silently. But OpenGL's
    buffer is exactly 1 in the sky, while the software renderer's has rounding errors for most near
    and far planes.
    """
    up = pybullet.computeViewMatrix([0, 0, 1e6], [0, 0, 2e6], [0, 1, 0])
    for near_m, far_m in ((0.1, 20.0), (0.02, 20.0), (0.1, 100.0), (0.1, 3.0)):
        projection = pybullet.computeProjectionMatrixFOV(60, 1, near_m, far_m)
        _, _, _, zbuffer, _ = client.getCameraImage(1, 1, up, projection, renderer=renderer)
        if np.asarray(zbuffer).item() != 1.0:
            return True
    return False
