"""Each transform under TorchRL's eleven cases."""

from __future__ import annotations

import functools

from flowrep.transforms import (
    Depth,
    FlowFactorize,
    FrameStack,
    RawFlow,
    Rgb,
    Segmentation,
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
