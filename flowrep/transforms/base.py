"""Base classes of transforms: one pure `compute` behind TorchRL's four entry points."""

from __future__ import annotations

import functools
import inspect
from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform

# One key (a string, or a tuple of strings if nested) or a list of keys, as in TorchRL.
Keys: TypeAlias = NestedKey | list[NestedKey]


class MissingKey(KeyError):
    """A transform needs a key that the TensorDict or the env's specs lack."""

    def __str__(self) -> str:
        """Returns the message without the quotes that KeyError adds."""
        return str(self.args[0])


class Reads(NamedTuple):
    """The layout that a transform expects under one input key, after any leading batch.

    `shape` holds the trailing sizes: numbers are fixed, names must agree between inputs. Motions
    and flow `spans_step`: they are of the env's last step, even if that isn't observed as one.
    """

    shape: tuple[int | str, ...]
    kind: Literal["float", "integer", "any"] = "any"
    spans_step: bool = False

    def __str__(self) -> str:
        """Returns the layout in the documentation's notation, e.g. `float [*B, 1, H, W]`."""
        sizes = ", ".join(str(size) for size in self.shape)
        return f"{'' if self.kind == 'any' else self.kind + ' '}[*B, {sizes}]"


_UNSIGNED = (torch.uint16, torch.uint32, torch.uint64)

DEPTH = Reads((1, "H", "W"), "float")
IDS = Reads((1, "H", "W"), "integer")
FLOW = Reads((2, "H", "W"), "float", spans_step=True)
RGB = Reads((3, "H", "W"), "integer")
POSE = Reads((4, 4), "float")
BODIES = Reads(("N", 4, 4), "float")  # poses, without the static world's
MOTION = Reads((4, 4), "float", spans_step=True)
MOTIONS = Reads(("1 + N", 4, 4), "float", spans_step=True)  # row 0 is the static world's


class MapTransform(Transform):
    """Reads tensors under `in_keys`, applies `compute` and writes the results under `out_keys`.

    A subclass defines the layout of its inputs (`reads`, one entry per input key), the pure
    function `compute` and the specs of its outputs (`output_specs`). It keeps no state between
    calls, so the results are the same in an env, at a reset and on shuffled samples of a replay
    buffer.

    TorchRL calls `_call` at each step, `_reset` at resets, `forward` on replay batches and
    `transform_observation_spec` for the specs. All four end up in `compute` or `output_specs`.

    Args:
        reads: the expected layout of each input, in the order of `in_keys`.
        writes: the number of outputs, each of which needs a key.

    Attributes:
        label: the representations that it serves, for error messages; by default its `out_keys`.
        compiled: whether `compute` runs through `torch.compile`; False by default.

    Raises:
        TypeError: `reads` isn't a list of layouts, or `compute` or `output_specs` returns no tuple.
        ValueError: the number of `in_keys` or `out_keys` is not that of inputs or outputs; or, in
            an env, a motion or flow of its last step isn't that between two observations.
    """

    # Pure: takes one tensor per input key, returns one per output key.
    compute: Callable[..., tuple[Tensor, ...]]
    # Takes the specs of the input keys, returns those of the output keys.
    output_specs: Callable[..., tuple[TensorSpec, ...]]

    def __init__(
        self, reads: Sequence[Reads], in_keys: Keys, out_keys: Keys, writes: int = 1
    ) -> None:
        super().__init__(in_keys=as_keys(in_keys), out_keys=as_keys(out_keys))
        if not all(isinstance(each, Reads) for each in reads):
            raise TypeError(
                f"{type(self).__name__}: reads are layouts, one for each of in_keys, such as DEPTH "
                f"or Reads((1, 'H', 'W'), 'float'); got {reads!r}"
            )
        if len(self.in_keys) != len(reads):
            raise ValueError(
                f"{type(self).__name__} reads {len(reads)} keys "
                f"({', '.join(map(str, reads))}), in_keys has {len(self.in_keys)}: {self.in_keys}"
            )
        if len(self.out_keys) != writes:
            raise ValueError(
                f"{type(self).__name__} writes {writes} keys, out_keys has {self.out_keys}"
            )
        if len({*self.out_keys}) < writes:
            raise ValueError(f"{type(self).__name__}: out_keys names a key twice: {self.out_keys}")
        self.reads = tuple(reads)
        self.compiled = False
        self._fitting: list[Any] | None = None  # shapes and types that have passed the check
        self.label = " and ".join(repr(key) for key in self.out_keys)

    def _inputs(self, source: TensorDictBase | Composite) -> list[Any]:
        """Returns the tensors or the specs under `in_keys`, once their layouts fit `reads`."""
        maps = [source.get(key, None) for key in self.in_keys]
        for key, value in zip(self.in_keys, maps):
            if value is None:
                offered = sorted(source.keys(True, True), key=str)
                remedy = "Name another one with in_keys=, or let the env emit it."
                if key[0] == "sensor" and source.get("sensor", None) is None:
                    remedy += " make_env drops sensor keys unless it gets keep_sensor=True."
                raise MissingKey(
                    f"representation {self.label} needs key {key!r}; the env offers {offered}. "
                    f"{remedy}"
                )
        # Repeated for each frame, the check would take as long as the flow of a small map.
        layout = [source.shape, *((value.shape, value.dtype) for value in maps)]
        if torch.compiler.is_compiling() or layout != self._fitting:
            self._check_layout(source.shape, maps)
            self._fitting = None if torch.compiler.is_compiling() else layout
        return maps

    def _check_layout(self, batch: torch.Size, maps: Sequence[Any]) -> None:
        """Raises ValueError if shapes and types of tensors or specs don't fit `reads`."""
        # `*B` is the first input's leading dims if these begin with the TensorDict's batch size,
        # since a spec or a TensorDict without batch size may hold batched inputs. If they don't,
        # `*B` is the batch size, and the check below fails.
        leading = maps[0].shape[: -len(self.reads[0].shape)]
        if leading[: len(batch)] == batch:
            batch = leading
        agreed: dict[str, int] = {}
        for key, reads, value in zip(self.in_keys, self.reads, maps):
            rank = len(reads.shape)
            sizes = [
                size if isinstance(size, int) else agreed.get(size, got)
                for size, got in zip(reads.shape, value.shape[-rank:])
            ]
            fits = len(sizes) == rank and tuple(value.shape) == (*batch, *sizes)
            if not fits or not _is_kind(value.dtype, reads.kind):
                known = {"*B": list(batch), **agreed}
                raise ValueError(
                    f"representation {self.label}: key {key!r} should be {reads} with "
                    f"{', '.join(f'{name} = {size}' for name, size in known.items())}; "
                    f"got {value.dtype} {list(value.shape)}"
                )
            agreed |= {name: n for name, n in zip(reads.shape, sizes) if isinstance(name, str)}

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Returns the inputs of `compute`; a subclass may check their values."""
        return self._with_signed_ids(self._inputs(tensordict))

    def _with_signed_ids(self, maps: Sequence[Tensor]) -> list[Tensor]:
        kinds = (reads.kind for reads in self.reads)
        return [
            x.long() if k == "integer" and x.dtype in _UNSIGNED else x for x, k in zip(maps, kinds)
        ]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        lacks = (next_tensordict.get(key, None) is None for key in self.in_keys)
        if self.missing_tolerance and any(lacks):
            return next_tensordict
        maps = self._tensors(next_tensordict)
        # The class's function, not the bound method: compiled once for all instances, which stay
        # picklable.
        compute = type(self).compute
        if self.compiled:
            compute = _compiled(compute)
        self._write(next_tensordict, compute(self, *maps), "compute")
        return next_tensordict

    def _write(self, into: Any, outputs: tuple[Any, ...], method: str) -> None:
        """Writes what a method of a subclass returned under `out_keys`."""
        if not isinstance(outputs, tuple) or len(outputs) != len(self.out_keys):
            raise TypeError(
                f"{type(self).__name__}.{method} should return a tuple, one item for each of "
                f"{self.out_keys}; got {type(outputs).__name__}"
            )
        for key, value in zip(self.out_keys, outputs):
            into.set(key, value)

    def _check_values(self, tensordict: TensorDictBase, *, waits: bool = False) -> None:
        """Raises ValueError for values that can't be right, if a subclass checks any.

        It is called for the envs that are reset and for the root of batches, never in a step. It
        may wait for a GPU only with `waits`, where all envs are reset.
        """

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Loops that read no specs don't call `transform_input_spec`.
        if not torch.compiler.is_compiling() and isinstance(_outermost(self), EnvBase):
            self._check_steps(self._beside())
        # TorchRL's `_reset` doesn't call the transform.
        begins = tensordict.get("_reset", None)
        rows = None
        # Selecting rows by a mask waits for a GPU, and each new number of rows would recompile.
        if begins is not None and not begins.is_cuda and not self.compiled:
            rows = flags_of_batch(begins, tensordict_reset)
        if rows is None or rows.all() == rows.any():
            self._check_values(tensordict_reset, waits=begins is None)
            return self._call(tensordict_reset)
        # TorchRL keeps only the rows that are reset. Computing the others, too, would be slow for
        # estimated flow: they get a copy of one that is reset.
        reset = tensordict_reset[rows]
        self._check_values(reset)
        reset = self._call(reset)
        at = (rows.flatten().cumsum(0) - 1).clamp(min=0).reshape(rows.shape)
        for key in self.out_keys:
            if (value := reset.get(key, None)) is not None:
                tensordict_reset.set(key, value[at])
        return tensordict_reset

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the outputs for a batch of any shape, at its root and under `"next"`.

        `"next"` is left unchanged if it holds none of the inputs, for example in a buffer that
        stores only the reward there.
        """
        if not torch.compiler.is_compiling():
            self._check_values(tensordict)
        tensordict = self._call(tensordict)
        following = tensordict.get("next", None)
        if following is not None and any(key in following.keys(True) for key in self.in_keys):
            tensordict.set("next", self._call(following))
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Returns the specs including those of the outputs."""
        specs = self._inputs(observation_spec)
        observation_spec = observation_spec.clone()
        self._write(observation_spec, self.output_specs(*specs), "output_specs")
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Returns the specs unchanged; refuses what the env steps over, see `Raises`."""
        input_spec = super().transform_input_spec(input_spec)
        if self.container is not None:
            self._check_steps(self._beside())
        return input_spec

    def _beside(self) -> list[Any]:
        """Returns all transforms of its env or of its outermost Compose, in their order."""
        outermost = _outermost(self)
        is_env, flat = isinstance(outermost, EnvBase), []
        waiting = [outermost.transform if is_env else outermost]
        while waiting:
            transform = waiting.pop(0)
            if isinstance(transform, Compose):
                waiting = [*transform.transforms, *waiting]
            else:
                flat.append(transform)
        return flat

    def _check_steps(self, transforms: list[Any]) -> None:
        """Raises ValueError if the env takes several steps where a motion or flow spans one."""
        before = [x for x in transforms[: transforms.index(self)] if isinstance(x, MapTransform)]
        written = {key for transform in before for key in transform.out_keys}
        of_env = [
            key for key, x in zip(self.in_keys, self.reads) if x.spans_step and key not in written
        ]
        if not of_env:
            return
        steppers = [type(x).__name__ for x in transforms if _methods_that_step(x.__class__)]
        if self.container.base_env.__dict__.get("wrapper_frame_skip", 1) > 1:
            steppers.append("frame_skip")
        if steppers:
            raise ValueError(
                f"{of_env[0]!r} is of the env's last step, and {steppers[0]} takes several steps "
                "between two observations. Let the env emit poses, which CameraMotion and "
                "InstanceMotion compare with those of the previous observation"
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.in_keys} -> {self.out_keys})"


def _outermost(transform: Any) -> Any:
    """Returns the env that holds a transform or, without one, its outermost Compose."""
    # `container` raises in a Compose that is in no env, as gymnasium's wrapper has one.
    while (weak := transform.__dict__.get("_container")) and (holder := weak()) is not None:
        transform = holder
    return transform


class RecurrentTransform(MapTransform):
    """A transform of the current and the previous step; it keeps no state itself.

    The previous step is read from the TensorDict passed to `step`. The env declares the
    `carried_keys` as part of its state, so that episodes and envs can't mix. `compute` returns the
    outputs at an episode's first frame, `advance` those at any other.

    In a replay buffer, stored outputs are left as they are. Outputs that are missing under `"next"`
    are computed from the root. Outputs that are missing at the root need a trajectory: a dimension
    named "time", and `("next", "done")`. Its first frame counts as an episode's first.
    """

    @property
    def carried_keys(self) -> list[NestedKey]:
        """The keys of the previous step that `advance` needs: by default the inputs."""
        return self.in_keys

    def compute(self, *now: Tensor) -> tuple[Tensor, ...]:
        """Returns the outputs at an episode's first frame: by default as if nothing changed."""
        return self.advance(now, now)

    @abstractmethod
    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Returns the outputs from the previous step's `carried_keys` and the current inputs."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        now, before = self._tensors(next_tensordict), self._carried(tensordict)
        if self.carried_keys == self.in_keys:
            for key, then, value in zip(self.in_keys, before, now):
                check_unconverted(key, then, value)
        outputs = self.advance(before, now)
        if _outermost(self).__dict__.get("_torchrl_native_autoreset", False):
            # Such an env returns the first frame of the next episode with the last step of this
            # one, and the transforms that follow have to see what is computed from it.
            done = flags_of_batch(next_tensordict.get("done"), next_tensordict)
            outputs = self._first_where(done, now, outputs)
        if (steps := tensordict.get("_step", None)) is not None:
            # TorchRL skips the step of some envs of a batch: these keep what they had, unless a
            # later transform has dropped it.
            steps = flags_of_batch(steps, tensordict)
            kept = (tensordict.get(key, new) for key, new in zip(self.out_keys, outputs))
            outputs = tuple(
                torch.where(expand_as_right(steps, new), new, old)
                for new, old in zip(outputs, kept)
            )
        for key, value in zip(self.out_keys, outputs):
            next_tensordict.set(key, value)
        return next_tensordict

    def _carried(self, tensordict: TensorDictBase) -> list[Tensor]:
        before = [tensordict.get(key, None) for key in self.carried_keys]
        for key, value in zip(self.carried_keys, before):
            if value is None:
                raise MissingKey(
                    f"representation {self.label} needs {key!r} of the previous step: pass step "
                    f"the TensorDict of reset or step_mdp, and let no later transform drop {key!r}"
                )
        return self._with_signed_ids(before) if self.carried_keys == self.in_keys else before

    def _first_where(
        self, begins: Tensor, now: Sequence[Tensor], outputs: Sequence[Tensor]
    ) -> tuple[Tensor, ...]:
        """Returns the outputs, with those of a first frame where `begins`, bool `[*B]`, is True."""
        return tuple(
            torch.where(expand_as_right(begins, first), first, later)
            for first, later in zip(self.compute(*now), outputs)
        )

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the outputs that a replay batch lacks, at its root and under `"next"`."""
        if not torch.compiler.is_compiling():
            self._check_writers()
        if missing := [key for key in self.out_keys if tensordict.get(key, None) is None]:
            outputs = self._along_trajectory(tensordict, missing[0])
            for key in missing:
                tensordict.set(key, outputs[key])
        following = tensordict.get("next", None)
        if following is None or not any(key in following.keys(True) for key in self.in_keys):
            return tensordict
        # A stored output is right even if the next frame is several steps ahead.
        if missing := [key for key in self.out_keys if following.get(key, None) is None]:
            _check_one_step(tensordict, ("next", missing[0]))
            later = self.advance(self._carried(tensordict), self._tensors(following))
            for key, value in zip(self.out_keys, later):
                if key in missing:
                    following.set(key, value)
            tensordict.set("next", following)
        return tensordict

    def _check_writers(self) -> None:
        """Raises ValueError if what an earlier transform writes would count as stored."""
        beside = self._beside()
        before = [x for x in beside[: beside.index(self)] if isinstance(x, MapTransform)]
        if twice := [key for key in self.out_keys for x in before if key in x.out_keys]:
            raise ValueError(
                f"{type(self).__name__} and an earlier transform write {twice[0]!r}, and in a "
                "batch the first output counts as the second: give each its out_keys"
            )

    def _along_trajectory(
        self, tensordict: TensorDictBase, missing: NestedKey
    ) -> dict[NestedKey, Tensor]:
        """Returns the outputs at each step of a trajectory, as the env would have given them."""
        now, done = self._tensors(tensordict), tensordict.get(("next", "done"), None)
        if done is None or "time" not in tensordict.names:
            raise MissingKey(
                f"{missing!r} is not in the batch, nor is the previous step it depends on: store "
                f"{missing!r}, or give a trajectory with ('next', 'done') and a dimension named "
                f"'time' (td.refine_names(..., 'time')); names are {tensordict.names}"
            )
        _check_one_step(tensordict, missing)  # n steps also say "done" n steps early
        time, is_end = tensordict.names.index("time"), flags_of_batch(done, tensordict)
        self._check_steps_follow(tensordict["next"], now, is_end, time)
        # Step by step, as the env does it: equal to the last bit, whatever a subclass computes.
        ended = is_end.unbind(time)
        steps: list[tuple[Tensor, ...]] = []
        before: list[Tensor] = []
        for t, frame in enumerate(zip(*(value.unbind(time) for value in now))):
            outputs = self.compute(*frame)
            if t > 0:
                outputs = self._first_where(ended[t - 1], frame, self.advance(before, frame))
            step = dict(zip([*self.in_keys, *self.out_keys], [*frame, *outputs]))
            before = [step[key] for key in self.carried_keys]
            steps.append(outputs)
        return {key: torch.stack(each, time) for key, each in zip(self.out_keys, zip(*steps))}

    def _check_steps_follow(
        self, following: TensorDictBase, now: Sequence[Tensor], is_end: Tensor, time: int
    ) -> None:
        """Raises ValueError if the next frame of a step isn't that of the step behind it."""
        count = is_end.shape[time] - 1
        for key, frames in zip(self.in_keys, now):
            after = following.get(key, None)
            if after is None or not has_values(frames):
                continue
            # Close, not equal, because buffers may hold next frames as differences.
            behind, after = frames.narrow(time, 1, count), after.narrow(time, 0, count)
            follows = torch.isclose(behind, after.to(behind.dtype), equal_nan=True)
            is_padding = (behind == 0).flatten(is_end.ndim).all(-1)  # of split_trajectories
            follows = follows.flatten(is_end.ndim).all(-1) | is_padding
            if not bool((follows | is_end.narrow(time, 0, count)).all()):
                raise ValueError(
                    f"{key!r} under 'next' is not that of the step behind, though no episode ends "
                    "there: steps that were shuffled, left out or joined are no trajectory, even "
                    f"if their dimension is named 'time'. Compute {self.label} before, or set "
                    "('next', 'done') where a rollout ends; SensorNoise needs a frame_key here"
                )

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Returns the input specs of `step`, including the `carried_keys`."""
        input_spec = super().transform_input_spec(input_spec)
        env = _outermost(self)
        if not isinstance(env, EnvBase):
            return input_spec
        # Not `parent`, with which TorchRL fails in a Compose that begins another Compose.
        output_spec, beside = env.base_env.output_spec.clone(), self._beside()
        for transform in beside[: beside.index(self) + 1]:
            output_spec = transform.transform_output_spec(output_spec)
        for key in self.carried_keys:
            # TorchRL's rollouts would keep the first frame's value for the whole episode.
            if key not in env.observation_spec.keys(True):
                raise ValueError(
                    f"a later transform drops {key!r}, which {type(self).__name__} reads again at "
                    "the next step: let it keep this key"
                )
            state, spec = input_spec["full_state_spec"], output_spec["full_observation_spec"]
            *groups, name = (key,) if isinstance(key, str) else key
            for group in groups:  # of several agents, say, with a batch size of its own
                spec = spec[group]
                if state.get(group, None) is None:
                    state[group] = Composite(shape=spec.shape, device=spec.device)
                state = state[group]
            state[name] = spec[name].clone()
        return input_spec

    def _check_steps(self, transforms: list[Any]) -> None:
        """Raises ValueError, too, if a later transform changes what the next step reads."""
        super()._check_steps(transforms)
        for transform in transforms:
            if "_inv_call" in _methods_that_step(transform.__class__):
                raise ValueError(
                    f"{type(transform).__name__} steps the env before its last step, so that "
                    f"{type(self).__name__} would read the last frame instead of the previous "
                    "observation: put the former into an inner TransformedEnv and the latter into "
                    "an outer one, with auto_unwrap=False"
                )
        for transform in transforms[transforms.index(self) + 1 :]:
            if keys := [key for key in self.carried_keys if key in transform.out_keys]:
                raise ValueError(
                    f"{type(transform).__name__} writes to {keys[0]!r}, which "
                    f"{type(self).__name__}, an earlier transform, reads again at the next step: "
                    "let it write to another key, or put it first"
                )
            if "_reset" in _methods_that_step(transform.__class__):
                raise ValueError(
                    f"{type(transform).__name__} steps the env at a reset, and what "
                    f"{type(self).__name__}, an earlier transform, writes is that of its last "
                    "step, not of an episode's first frame: put it first"
                )


def _check_one_step(tensordict: TensorDictBase, lost: NestedKey) -> None:
    """Raises MissingKey for a batch of n-step returns, as TorchRL's MultiStep marks them."""
    steps = tensordict.get("steps_to_next_obs", None)
    if steps is not None and bool((steps != 1).any()):
        raise MissingKey(
            f"{lost!r} is not in the batch, and can't be computed: its next frames lie up to "
            f"{int(steps.max())} steps ahead ('steps_to_next_obs'). Store {lost!r} as "
            "the env gave it, before MultiStepTransform moves it"
        )


def as_keys(keys: Keys) -> list[NestedKey]:
    """Returns a list of keys; a nested key may be given as a list, as YAML has no tuples."""
    if isinstance(keys, (str, tuple)):
        return [keys]
    return [key if isinstance(key, str) else tuple(key) for key in keys]


def check_distinct_keys(transform: MapTransform) -> None:
    """Raises ValueError if a transform would overwrite a key that it reads."""
    shared = sorted({str(key) for key in transform.in_keys} & {str(k) for k in transform.out_keys})
    if shared:
        raise ValueError(
            f"{type(transform).__name__} reads and writes {', '.join(shared)}: a second pass, for "
            "instance in a replay buffer, would convert it twice; give out_keys= other names"
        )


def check_choice(option: str, chosen: Sequence[str], known: Collection[str]) -> None:
    """Raises ValueError unless `chosen` is a list of some of the known names, each once."""
    is_wrong = isinstance(chosen, str) or not chosen or not set(chosen) <= set(known)
    if is_wrong or len(set(chosen)) != len(chosen):
        raise ValueError(
            f"{option} must be a list with some of {list(known)}, each once; got {chosen!r}"
        )


def flags_of_batch(flags: Tensor, tensordict: TensorDictBase) -> Tensor:
    """Returns flags such as `done`, `[*B]` or `[*B, 1]`, as `[*B]`, the TensorDict's batch size."""
    batch_dims = tensordict.ndim
    return flags.flatten(batch_dims).any(-1) if flags.ndim > batch_dims else flags


@functools.cache
def _methods_that_step(kind: type[Transform]) -> set[str]:
    """Returns the names of a transform's methods that step its env, such as TorchRL's frame skip.

    TorchRL has no flag for it. But a transform reaches its env as its `parent`, so a method's code
    names this attribute beside a step.
    """
    code = {
        name: {*inspect.unwrap(method).__code__.co_names}
        for each in reversed(kind.__mro__)
        if each not in Transform.__mro__
        for name, method in vars(each).items()
        if inspect.isfunction(method)
    }
    steps, env = {"step", "_step", "rand_step"}, {"parent", "base_env"}
    return {name for name, names in code.items() if names & steps and names & env}


@functools.cache
def _compiled(compute: Callable[..., tuple[Tensor, ...]]) -> Callable[..., tuple[Tensor, ...]]:
    """Returns a class's compiled `compute`, cached here so that instances can be pickled."""
    return torch.compile(compute, fullgraph=True)


def check_unconverted(key: NestedKey, before: Tensor, now: Tensor) -> None:
    """Raises ValueError if the previous step's value of a key has another dtype than this one's."""
    if before.dtype != now.dtype:
        raise ValueError(
            f"{key!r} of the previous step is {before.dtype}, and that of this step {now.dtype}: "
            "what converts it afterwards has to write to another key"
        )


def has_values(x: Tensor) -> bool:
    """Returns whether a check may read values: meta tensors and compiled code have none."""
    return not (x.is_meta or torch.compiler.is_compiling())


def signed_type(dtype: torch.dtype) -> torch.dtype:
    """Returns int64 for the unsigned types for which PyTorch lacks most functions."""
    return torch.int64 if dtype in _UNSIGNED else dtype


def _is_kind(dtype: torch.dtype, kind: str) -> bool:
    if kind == "float":
        return dtype.is_floating_point
    if kind == "integer":
        return not (dtype.is_floating_point or dtype.is_complex or dtype is torch.bool)
    return True
