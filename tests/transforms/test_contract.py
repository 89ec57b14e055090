"""Each transform under TorchRL's eleven cases."""

from __future__ import annotations

import functools

from flowrep.transforms import (
    AdaptDepth,
    AdaptFlow,
    AdaptPose,
    CameraMotion,
    Depth,
    EstimateCameraMotion,
    FlowFactorize,
    FrameStack,
    InstanceIds,
    InstanceMotion,
    RawFlow,
    Rgb,
    Segmentation,
    SensorNoise,
    representation_stack,
)
from tests.transforms import oracles
from tests.transforms.contract import TransformContract
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES


class TestSegmentation(TransformContract):
    def oracles(self):
        return {"seg": oracles.seg}

    def make(self):
        return Segmentation(NUM_CLASSES)


class TestDepth(TransformContract):
    def oracles(self):
        return {"depth": functools.partial(oracles.depth, range_m=14.0)}

    def make(self):
        return Depth(range_m=14.0)


class TestRgb(TransformContract):
    def oracles(self):
        return {"rgb": oracles.rgb}

    def make(self):
        return Rgb()


class TestRawFlow(TransformContract):
    def oracles(self):
        return {"raw": oracles.raw, "known": oracles.valid}

    def make(self):
        return RawFlow(INTRINSICS, outputs=["raw", "valid"], out_keys=["raw", "known"])


class TestFlowFactorize(TransformContract):
    def oracles(self):
        return {
            "ego": oracles.ego,
            "obj": oracles.obj,
            "raw2": oracles.raw,
            "valid": oracles.valid,
        }

    def make(self):
        outputs = ["ego", "obj", "raw", "valid"]
        out_keys = ["ego", "obj", "raw2", "valid"]
        return FlowFactorize(INTRINSICS, outputs=outputs, out_keys=out_keys)

    def before(self):
        return [RawFlow(INTRINSICS)]


class TestFrameStack(TransformContract):
    def oracles(self):
        return {
            ("stack", "rgb"): functools.partial(oracles.stacked, "rgb", k=3),
            ("stack", "ids"): functools.partial(oracles.stacked, "semantic", k=3),
        }

    def make(self):
        in_keys = [("sensor", "rgb"), ("sensor", "semantic")]
        return FrameStack(k=3, in_keys=in_keys, out_keys=list(self.oracles()))

    def replay_inputs(self):
        # Single transitions can't tell their past: the root's stacks are stored with them.
        td = self.make()(self.inputs())
        return td.exclude(*(("next", *key) for key in self.oracles()))


class TestAdaptDepth(TransformContract):
    def oracles(self):
        return {"z": oracles.ray_length_to_z}

    def make(self):
        depth = ("sensor", "depth")
        return AdaptDepth("ray_length", intrinsics=INTRINSICS, in_keys=depth, out_keys="z")


class TestAdaptPose(TransformContract):
    def oracles(self):
        return {("adapted", "pose"): oracles.opengl_pose}

    def make(self):
        keys = {"in_keys": ("sensor", "world_from_cam"), "out_keys": ("adapted", "pose")}
        return AdaptPose(axes="opengl", **keys)


class TestAdaptFlow(TransformContract):
    def oracles(self):
        return {"measured": oracles.rows_backward}

    def make(self):
        keys = {"in_keys": "raw", "out_keys": "measured"}
        return AdaptFlow(direction="backward", grid="current", channels="row_column", **keys)

    def before(self):
        return [RawFlow(INTRINSICS)]


class TestInstanceIds(TransformContract):
    def oracles(self):
        return {"rows": functools.partial(oracles.rows_of_classes, bodies=[3, 1])}

    def make(self):
        return InstanceIds([3, 1], in_keys=("sensor", "semantic"), out_keys="rows")


class TestCameraMotion(TransformContract):
    def oracles(self):
        return {("own", "motion"): functools.partial(oracles.sensor_map, "prev_from_curr")}

    def make(self):
        return CameraMotion(out_keys=[("own", "motion")])

    def replay_inputs(self):
        # Single transitions can't tell their past: the root's motion is stored with them.
        td = self.make()(self.inputs())
        return td.exclude(*(("next", *key) for key in self.oracles()))


class TestInstanceMotion(TestCameraMotion):
    def oracles(self):
        return {("own", "motions"): functools.partial(oracles.sensor_map, "instance_motion")}

    def make(self):
        return InstanceMotion(out_keys=[("own", "motions")])


class TestEstimateCameraMotion(TransformContract):
    def oracles(self):
        return {("own", "motion"): functools.partial(oracles.sensor_map, "prev_from_curr")}

    def make(self):
        return EstimateCameraMotion(
            INTRINSICS, outputs=["motion"], out_keys=[("own", "motion")], prior=None
        )

    def before(self):
        return [RawFlow(INTRINSICS)]


class TestSensorNoiseOff(TransformContract):
    def oracles(self):
        return {
            "depth": functools.partial(oracles.sensor_map, "depth"),
            "motion": functools.partial(oracles.sensor_map, "prev_from_curr"),
        }

    def make(self):
        return SensorNoise(out_keys=list(self.oracles()))


class TestSensorNoiseWithoutAnyEcho(TransformContract):
    def oracles(self):
        return {"depth": oracles.hole}

    def make(self):
        return SensorNoise(sensors=["depth"], depth_dropout=1.0, out_keys="depth")


class TestRepresentationStack(TransformContract):
    def oracles(self):
        return {
            "obj": oracles.obj,
            "raw": oracles.raw,
            "ego": oracles.ego,
            "depth": oracles.depth,
            "seg": oracles.seg,
            "rgb": oracles.rgb,
            "seg2": functools.partial(oracles.stacked, "semantic", k=2),
        }

    def make(self):
        return representation_stack(
            list(self.oracles()), intrinsics=INTRINSICS, num_classes=NUM_CLASSES
        )

    def replay_inputs(self):
        stored = FrameStack(in_keys=[("sensor", "semantic")], out_keys=["seg2"])(self.inputs())
        return stored.exclude(("next", "seg2"))
