"""External policies in flowrep's environments: their task, observations and actions."""

import pickle
import sys
import sysconfig
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.export.passes import move_to_device_pass
from torchrl.data import Composite, TensorSpec

PROGRAM = ".pt2"
STANDARD_LIBRARY = (sysconfig.get_path("stdlib"), "<frozen ")
MEMORY_KEYS = ("street", "is_init")
"""Keys for policies with state: each row's environment, and whether its episode just began."""


class PolicyError(Exception):
    """An external policy is missing, fails or returns no actions; the message names it."""


@dataclass(frozen=True)
class Task:
    """The task, as described to the function that makes a policy.

    Args:
        scene: its name.
        representations: the maps' names, in the requested order, with their options.
        observation_spec: of the maps of one environment, `[C, H, W]` each.
        action_spec: of one environment: 0 goes straight on, 1 turns left, 2 turns right.
        intrinsics: K `[3, 3]` of the maps, pixels.
        device: of the maps.
    """

    scene: str
    representations: Mapping[str, Any]
    observation_spec: Composite
    action_spec: TensorSpec
    intrinsics: Tensor
    device: torch.device


class ForeignPolicy:
    """Writes `action` `[N]`, computed by an external function.

    The function takes a TensorDict of batch `[N]` that holds only the task's maps `[N, C, H, W]`,
    `street` int64 `[N]` and `is_init` bool `[N, 1]`. It returns N integers (a tensor, an array or a
    list), or the TensorDict with `action`.

    Args:
        name: of the policy, for error messages.
        act: the function.
        task: the policy's task.
    """

    def __init__(self, name: str, act: Callable[[TensorDictBase], Any], task: Task) -> None:
        self.name, self._act, self._task = name, act, task

    def __call__(self, maps: TensorDictBase) -> TensorDictBase:
        """Returns the maps with `action`.

        Raises:
            PolicyError: if the function fails or returns anything but actions.
        """
        seen = maps.select(*self._task.representations, *MEMORY_KEYS)
        with _named(self.name):
            given = self._act(seen)
        if isinstance(given, TensorDictBase):
            given = given.get("action")
        return maps.set("action", self._checked(given, len(maps)))

    def __reduce__(self) -> Any:
        """Refuses to be pickled: its function may hold anything, and stays in this process."""
        raise pickle.PicklingError(f"policy '{self.name}' stays in its process")

    def alone(self) -> Callable[[TensorDictBase], TensorDictBase]:
        """Returns the policy for one episode of a single environment, from its reset on."""
        begun = False

        def act(tensordict: TensorDictBase) -> TensorDictBase:
            nonlocal begun
            tensordict = tensordict.copy()
            tensordict["street"] = torch.zeros(1, dtype=torch.int64)
            tensordict["is_init"] = torch.full((1, 1), not begun)
            begun = True
            return self(tensordict).exclude(*MEMORY_KEYS)

        return act

    def _checked(self, given: Any, count: int) -> Tensor:
        n = int(self._task.action_spec.space.n)
        expected = f"{count} whole numbers from 0 to {n - 1}, one action per environment"
        try:
            actions = torch.as_tensor(given).cpu()
        except (TypeError, ValueError, RuntimeError):
            raise PolicyError(
                f"policy '{self.name}' returned a {type(given).__name__}; expected {expected}"
            ) from None
        if actions.is_floating_point() or actions.is_complex() or actions.shape != (count,):
            raise PolicyError(
                f"policy '{self.name}' returned {actions.dtype} of shape {tuple(actions.shape)}; "
                f"expected {expected}"
            )
        if not ((actions >= 0) & (actions < n)).all():
            raise PolicyError(
                f"policy '{self.name}' returned {actions.tolist()}; expected {expected}"
            )
        return actions.long()


def load_policy(reference: str, task: Task) -> ForeignPolicy:
    """Returns an external policy.

    Args:
        reference: `path.py:make` or `package.module:make`, a function that is called with the task
            and returns the policy's function; or `path.pt2`, a program saved by `torch.export.save`
            that takes the maps as arguments, in the task's order, and returns a score per action.
        task: the policy's task.

    Raises:
        PolicyError: if the file, module or function doesn't exist or fails.
    """
    if reference.endswith(PROGRAM):
        return ForeignPolicy(reference, _program(reference, task), task)
    place, _, name = reference.rpartition(":")
    with _named(reference):
        module = _module(reference, place)
        make = getattr(module, name, None)
        if not callable(make):
            there = [key for key, value in vars(module).items() if _is_own(value, module)]
            raise PolicyError(
                f"policy '{reference}': {place} has no function '{name}'; there are: "
                f"{', '.join(there) or 'none'}"
            )
        act = make(task)
    if not callable(act):
        raise PolicyError(
            f"policy '{reference}': {name}(task) returned a {type(act).__name__}; expected a "
            "function of a TensorDict of maps"
        )
    return ForeignPolicy(reference, act, task)


def is_reference(text: str) -> bool:
    """Returns whether `text` is a reference to an external policy, see `load_policy`.

    >>> is_reference("mine.py:make"), is_reference("a.b:make"), is_reference("agent.pt2")
    (True, True, True)
    >>> is_reference("greedy"), is_reference("mine.py"), is_reference(":make")
    (False, False, False)
    """
    place, _, name = text.rpartition(":")
    return text.endswith(PROGRAM) or bool(place and name.isidentifier())


def _module(reference: str, place: str) -> Any:
    if not place.endswith(".py"):
        try:
            return import_module(place)
        except ModuleNotFoundError as error:
            if error.name and place.startswith(error.name):
                raise PolicyError(
                    f"policy '{reference}': there is no module {error.name}; is its folder in "
                    "PYTHONPATH? A file is named with its ending: path.py:make"
                ) from None
            raise
    path = Path(place)
    if not path.is_file():
        raise PolicyError(f"policy '{reference}': there is no file {place}")
    sys.path.insert(0, str(path.parent.resolve()))  # as Python does for a script
    spec = spec_from_file_location(f"flowrep_policy_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module


def _program(path: str, task: Task) -> Callable[[TensorDictBase], Tensor]:
    if not Path(path).is_file():
        raise PolicyError(f"policy '{path}': there is no such file")
    with _named(path):
        # moving the module alone would leave the devices that its graph names
        program = move_to_device_pass(torch.export.load(path), task.device).module()

    @torch.no_grad()
    def act(maps: TensorDictBase) -> Tensor:
        return program(*(maps[name] for name in task.representations)).argmax(-1)

    return act


def _is_own(value: Any, module: Any) -> bool:
    return callable(value) and getattr(value, "__module__", None) == module.__name__


class _named:
    """Turns any exception in external code into a PolicyError of one line, with its location."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        """Does nothing."""

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Raises PolicyError if the block raised another exception."""
        if error is None or isinstance(error, PolicyError) or not isinstance(error, Exception):
            return
        text = str(error).strip().splitlines()
        raise PolicyError(
            f"policy '{self.name}' failed: {type(error).__name__}: {text[0] if text else ''}"
            f"{_place(trace)}"
        ) from error


def _place(trace: Any) -> str:
    """Returns the last line of the author's own code, rather than one deep in a library."""
    frames = [frame for frame in traceback.extract_tb(trace) if frame.filename != __file__]
    installed = [frame for frame in frames if "site-packages" in frame.filename]
    own = [
        frame
        for frame in frames
        if frame not in installed and not frame.filename.startswith(STANDARD_LIBRARY)
    ]
    # a policy may be installed as well; then it is the line that flowrep called
    for frame in own[-1:] or installed[:1]:
        return f" ({frame.filename}, line {frame.lineno})"
    return ""
