"""Every transform computes in one graph for any batch, on any device, and never waits for a GPU."""

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torchrl.envs.transforms import Compose

from flowrep import transforms as T
from tests.transforms.fake_env import moments
from tests.transforms.test_contract import CASES as CONTRACT
from tests.transforms.test_contract import Case

KEY = ("sensor", "K")
NOISE = {"depth_sigma_per_m": 0.1, "depth_dropout": 0.2, "drift_m": 0.1, "drift_rad": 0.2}
NAMES = [
    *("Segmentation, onehot", "Depth", "RawFlow", "FlowFactorize", "AdaptDepth", "AdaptPose"),
    *("AdaptFlow", "InstanceIds", "FrameStack", "CameraMotion", "InstanceMotion"),
]
CASES = {name: CONTRACT[name] for name in NAMES}
CASES["noise by frame"] = Case(lambda: T.SensorNoise(**NOISE, frame_key="frame"), {})
each_case = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


def of(case, count):
    """Returns what runs once a step, `compute` or `advance`, and its tensors of some moments."""
    td = moments(count).set("frame", torch.arange(2 * count).reshape(-1, 2))
    transform, td = case.make(), Compose(*case.before())(td)
    now = [td[key] for key in transform.in_keys]
    if not case.carries:
        return transform.compute, now
    known = dict(zip([*transform.in_keys, *transform.out_keys], [*now, *transform.compute(*now)]))
    before = [known[key].flip(0) for key in transform.carried_keys]

    def advance(*maps):
        return transform.advance(maps[: len(before)], maps[len(before) :])

    return advance, [*before, *now]


@pytest.mark.slow_after_first
@each_case
def test_one_graph_for_all_batches(case):
    torch._dynamo.reset()
    function, _ = of(case, 11)
    counter = CompileCounter()  # counts graphs, and runs them eagerly
    compiled = torch.compile(function, fullgraph=True, dynamic=True, backend=counter)
    for batch in (11, 2):  # first one that equals no other size: torch would tie the two
        _, given = of(case, batch)
        for got, want in zip(compiled(*given), function(*given)):
            assert torch.equal(got.nan_to_num(), want.nan_to_num())
    assert counter.frame_count == 1
    torch._dynamo.reset()


SENSORS = ["depth", "instance", "instance_motion", "prev_from_curr", "K"]


CAMERA = {"intrinsics": KEY, "prev_intrinsics": KEY}


class Wrapped(torch.nn.Module):
    """Takes tensors, as a program that is exported has to."""

    def __init__(self, make, writes):
        super().__init__()
        self.transform, self.writes = make(), writes

    def forward(self, *sensors):
        td = self.transform(TensorDict({"sensor": dict(zip(SENSORS, sensors))}, [3]))
        return tuple(td[key] for key in self.writes)


@pytest.mark.parametrize(
    "stack",
    [
        (lambda: Compose(T.RawFlow(**CAMERA), T.FlowFactorize(**CAMERA)), ["raw", "obj"]),
        # noise that is drawn anew at each call
        (lambda: T.SensorNoise(**NOISE, seed=1, out_keys=["z", "motion"]), ["z", "motion"]),
    ],
    ids=["flow", "noise"],
)
def test_a_stack_is_compiled_and_exported_and_runs_on_meta_tensors(stack):
    torch.compiler.reset()
    eager, given = Wrapped(*stack), tuple(moments(3)["sensor", name] for name in SENSORS)
    compiled = torch.compile(Wrapped(*stack), fullgraph=True, backend="eager")
    exported = torch.export.export(Wrapped(*stack), given).module()
    for _ in range(3):
        want = eager(*given)
        for run in (compiled, exported):
            torch.testing.assert_close(run(*given), want, rtol=0, atol=0, equal_nan=True)
    assert all(each.is_meta for each in eager.to("meta")(*(x.to("meta") for x in given)))


CHECKED = {
    "AdaptPose": (T.AdaptPose(in_keys="x"), torch.eye(4)),
    "InstanceIds": (T.InstanceIds([3], in_keys="x"), torch.tensor([[[3, 0, 3]]])),
    "Segmentation": (T.Segmentation(3, in_keys="x"), torch.tensor([[[2, 0, 255]]])),
}


@pytest.mark.parametrize(("transform", "given"), CHECKED.values(), ids=list(CHECKED))
def test_transforms_that_check_values_compile_to_one_graph(transform, given):
    (key,), given = transform.out_keys, TensorDict(x=given)
    compiled = torch.compile(transform, fullgraph=True, backend="eager")
    assert torch.equal(compiled(given.clone())[key], transform(given.clone())[key])
    assert transform.to("meta")(given.to("meta"))[key].is_meta


def test_compiled_code_refuses_class_ids_that_would_wrap_too():
    wrong = TensorDict(x=torch.tensor([[[300]]]))
    with pytest.raises(RuntimeError, match="beyond 0 to 255"):
        torch.compile(T.Segmentation(3, in_keys="x"), fullgraph=True, backend="eager")(wrong)


def on(device, case):
    """Returns a case's function and tensors on a device."""
    function, given = of(case, 3)
    if (owner := getattr(function, "__self__", None)) is not None:
        owner.to(device)
    return function, [each.to(device) for each in given]


@each_case
def test_moves_to_another_device(case):
    function, given = on("meta", case)
    assert all(output.is_meta for output in function(*given))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@each_case
def test_a_gpu_gives_what_the_cpu_gives_without_waiting(case):
    compute, on_cpu = on("cpu", case)
    want = compute(*on_cpu)
    function, given = on("cuda", case)
    function(*given)  # what is set up once may wait
    torch.cuda.set_sync_debug_mode("error")
    try:
        got = function(*given)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for on_gpu, expected in zip(got, want):
        assert on_gpu.is_cuda
        torch.testing.assert_close(on_gpu.cpu(), expected, atol=1e-5, rtol=1e-5, equal_nan=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_noise_is_drawn_on_the_gpu_without_waiting():
    noise = T.SensorNoise(**NOISE)
    given = [moments(3)[key].to("cuda") for key in noise.in_keys]
    noise.compute(*given)
    torch.cuda.set_sync_debug_mode("error")
    try:
        depth, motion = noise.compute(*given)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert depth.is_cuda
    assert motion.is_cuda
