"""Options that can't be are refused when a transform is made, in words that name them."""

import math
from functools import partial

import pytest
import torch

from flowrep import transforms as T
from tests.transforms.fake_env import INTRINSICS
from tests.transforms.oracles import brightening

SWAPPED = [0, 2, 1]
SKEWED = [[6.0, 0.1, 3.0], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]]
BETWEEN = [[6.0, 0.0, 2.6], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]]  # 2 cx is not whole
frames = partial(T.FrameStack, in_keys=["seg"])
factorize = partial(T.FlowFactorize, INTRINSICS)
mirror = partial(T.Mirror, ["raw", "seg"], flow_keys="raw", swapped_actions=SWAPPED)
stack = partial(T.representation_stack, intrinsics=INTRINSICS, num_classes=4)
MISTAKES = {
    r"some of \['depth', 'motion', 'flow'\], each once": lambda: T.SensorNoise(sensors=["deep"]),
    r"depth_sigma_per_m.* -0\.1": lambda: T.SensorNoise(depth_sigma_per_m=-0.1),
    r"drift_m.* inf": lambda: T.SensorNoise(drift_m=math.inf),
    r"depth_dropout.* 1\.5": lambda: T.SensorNoise(depth_dropout=1.5),
    r"flow_sigma_px.*'flow'": lambda: T.SensorNoise(flow_sigma_px=1.0),
    r"seed.* 1\.5": lambda: T.SensorNoise(seed=1.5),
    r"writes 2 keys": lambda: T.SensorNoise(out_keys=["only"]),
    r"k must be .* 0": lambda: frames(k=0, out_keys=["seg2"]),
    r"k must be .* 1\.5": lambda: frames(k=1.5, out_keys=["seg2"]),
    r"reads and writes seg": lambda: frames(out_keys=["seg"]),
    r"writes 1 keys": lambda: frames(out_keys=["a", "b"]),
    r"\['ids', 'onehot'\], got 'rgb'": lambda: T.Segmentation(3, encoding="rgb"),
    r"1 to 256": lambda: T.Segmentation(257),
    r"num_classes.* 2\.5": lambda: T.Segmentation(2.5),
    r"range_m must be a positive": lambda: T.Depth(range_m=math.inf),
    r"missing must be in \[0, 1\]": lambda: T.Depth(missing=1.5),
    r"needs \['K'\].* intrinsics": lambda: T.AdaptDepth("ray_length"),
    r"reads and writes depth: a second pass": lambda: T.AdaptDepth("z", out_keys="depth"),
    r"'unity'\], got 'gl'": lambda: T.AdaptPose(axes="gl"),
    r"swap the two pictures": lambda: T.AdaptFlow(direction="forward", grid="previous"),
    r"body_ids.*once, got \[3, 1, 3\]": lambda: T.InstanceIds([3, 1, 3]),
    r"flow_keys has \['ego'\]": lambda: mirror(flow_keys="ego"),
    r"twice.*raw": lambda: T.Mirror(["raw", "raw"], swapped_actions=SWAPPED),
    r"swapped_actions": lambda: mirror(swapped_actions=[1, 2, 0]),
    r"images": lambda: mirror(images="some"),
    r"cx is 2\.6": lambda: mirror(intrinsics=BETWEEN),
    r"intrinsics should be .* without skew": lambda: mirror(intrinsics=SKEWED),
    r"outputs.*'pose'": lambda: T.EstimateCameraMotion(INTRINSICS, outputs=["pose"]),
    r"writes \d keys, out_keys": lambda: T.EstimateCameraMotion(INTRINSICS, out_keys=["motion"]),
    r"reads 3 keys .* in_keys has 1": lambda: T.RawFlow(INTRINSICS, in_keys=["depth"]),
    r"writes 2 keys, out_keys has \['ego'\]": lambda: T.FlowFactorize(INTRINSICS, out_keys=["ego"]),
    r"\['ego', 'obj', 'raw', 'valid'\], each once": lambda: factorize(outputs=["ego", "eggo"]),
    r"each once": lambda: factorize(outputs=["ego", "ego"]),
    r"must be a list": lambda: factorize(outputs="ego"),
    r"scale must be a finite number other than 0": lambda: factorize(scale=0.0),
    r"^scale needs one value for each of \['ego', 'obj'\]": lambda: factorize(scale={"ego": 1.0}),
    r"K, \[3, 3\], or the key of .*; got \[4, 4\]": lambda: T.FlowFactorize(torch.eye(4)),
    r"\['dis', 'raft_small', 'raft_large'\].*'farneback'": lambda: T.EstimatedFlow("farneback"),
    r"'raft_small'.*weights=": lambda: T.EstimatedFlow("raft_small"),
    r"weights=.*'dis'": lambda: T.EstimatedFlow(weights="w.pth"),
    r"preset must be one of .*'fine'\], got 'slow'": lambda: T.EstimatedFlow(preset="slow"),
    r"min_side_px.* 0": lambda: T.EstimatedFlow(min_side_px=0),
    r"min_side_px.* 95\.5": lambda: T.EstimatedFlow(min_side_px=95.5),
    r"picture_scale.* 0": lambda: T.EstimatedFlow(brightening, picture_scale=0),
    r"picture_scale.* 1\.5": lambda: T.EstimatedFlow(brightening, picture_scale=1.5),
    r"preset='slow'.*function": lambda: T.EstimatedFlow(brightening, preset="slow"),
    r"min_side_px=96.*DIS\(": lambda: T.EstimatedFlow(brightening, min_side_px=96),
    r"scale=2\.0.*unscaled": lambda: T.EstimatedFlow(outputs=["unscaled"], scale=2.0),
    r"some of \['raw', 'unscaled'\]": lambda: T.EstimatedFlow(outputs=["valid"]),
    # A simulator's conventions
    r"isaac_lab": lambda: T.sensors_from("isaac"),
    r"forward_depth": lambda: T.sensors_from("newton", depth="z"),
    r"needs far_m=": lambda: T.sensors_from("mujoco"),
    r"doesn't read far_m=": lambda: T.sensors_from("maniskill", far_m=9.0),
    r"needs intrinsics=": lambda: T.sensors_from("kubric"),
    r"has no flow": lambda: T.sensors_from("carla", flow=True),
    r"static_ids needs body_ids": lambda: T.sensors_from("carla", static_ids=[7]),
    r"keys= names .*depth": lambda: T.sensors_from("newton", keys={"depth": "z"}),
    # A list of representations, whose options are checked whether or not they are used
    r"unknown representation 'eggo'.*'depth2'": lambda: stack(["eggo"]),
    r"'ego' is named twice": lambda: stack(["ego", "obj", "ego"]),
    r"'depth': 'rangem'.*'missing'": lambda: stack({"depth": {"rangem": 3}}),
    r"must be a list of names.*'ego'": lambda: stack("ego"),
    r"representation 'ego' must be a mapping.*2\.0": lambda: stack({"ego": 2.0}),
    r"scale must be .*tensor": lambda: stack({"raw": {"scale": torch.ones(2)}}),
    r"unknown source of flow 'guessed'.*\['exact', 'estimated'\]": lambda: stack(
        ["raw"], flow="guessed"
    ),
    r"'presets'.*'preset'": lambda: stack(["raw"], flow={"source": "estimated", "presets": "fast"}),
    r"option of exact flow: 'preset'": lambda: stack(
        ["raw"], flow={"source": "exact", "preset": "fast"}
    ),
    r"unknown source of flow 2\.5": lambda: stack(["raw"], flow=2.5),
    r"'odometry'.*'estimated'": lambda: stack(["raw"], motion="odometry"),
    r"noise must be a mapping.*0\.1": lambda: stack(["raw"], noise=0.1),
    r"option of noise: 'depth_sigma'.*'depth_sigma_per_m'": lambda: stack(
        ["raw"], noise={"depth_sigma": 0.1}
    ),
    r"drift_m must be a finite number of at least 0, got -0\.1": lambda: stack(
        ["raw"], noise={"drift_m": -0.1}
    ),
    r"rate_hz must be a positive.*'12'": lambda: stack({"ego": {"rate_hz": "12"}}, frame_rate_hz=6),
    r"scale must be a finite.*'2'": lambda: stack(
        {"ego": {"rate_hz": 12, "scale": "2"}}, frame_rate_hz=6
    ),
    r"frame_rate_hz must be.*None": lambda: stack({"ego": {"rate_hz": 12}}),
    r"need num_classes=": lambda: T.representation_stack(["seg2"]),
    r"need intrinsics=": lambda: T.representation_stack(["depth", "ego"], num_classes=3),
}


@pytest.mark.parametrize(("words", "call"), MISTAKES.items())
def test_a_mistake_is_named(words, call):
    with pytest.raises(ValueError, match=words):
        call()


def test_representations_without_flow_or_classes_need_no_k():
    assert T.representation_stack(["depth", "rgb"])
