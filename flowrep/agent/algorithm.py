"""The update that all algorithms share, and what training calls.

`OffPolicy` adds a replay memory; the losses are in a file per algorithm.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform
from torchrl.objectives import LossModule, SoftUpdate

from flowrep.agent.cuda_graph import as_cuda_graph
from flowrep.agent.divergence import DivergenceWatch
from flowrep.agent.map_codec import MapCodec, map_codecs
from flowrep.agent.networks import MapNetwork, PolicyNetwork, action_count, stochastic_policy
from flowrep.agent.precision import compute_dtype
from flowrep.agent.replay import OUTCOME, ReplayMemory
from flowrep.config.algorithms import AlgorithmOptions, OffPolicyOptions


class Algorithm(ABC):
    """Acts with `policy`, stores frames in `memory` and takes updates on samples from it.

    ```
    acted = algorithm.act(observation)                      # writes `action`
    for _ in range(algorithm.updates_due(frames)):
        metrics = algorithm.update(algorithm.sample())
    algorithm.remember(steps)                               # with reward and next observation
    ```

    The objective is a TorchRL `LossModule`. This class adds the rest of an update: learning-rate
    schedule, Adam, target networks, CUDA graph and divergence check. A subclass sets `policy`
    (with `make_policy`, which evaluation uses too) and `memory`, passes its loss to this
    constructor and implements `sample` and `updates_due`. The loss's weights, the memory and
    Adam's state, all of which are saved, are then enough to resume.

    Args:
        loss: its parameters are trained, its target parameters follow them.
        learning_rate: of Adam; it falls linearly to 0 over `total_updates`.
        total_updates: number of updates of the whole training.
        tau: weight of the online weights in each update of the targets; None without targets.
        max_grad_norm: the norm over all gradients is scaled down to this maximum.
    """

    OPTIONS: ClassVar[type[AlgorithmOptions]]
    """What a config may set; the constructor takes an instance of it."""

    METRICS: ClassVar[Mapping[str, str]]
    """Logged metrics, each with its key in the loss's output. The sum of those that end in `_loss`
    is minimised."""

    LOSS: ClassVar[Callable[..., LossModule]]
    """Builds the loss from the policy's `MapNetwork`, the number of actions and the options."""

    CAPTURABLE: ClassVar[bool] = True
    """Whether `losses` and `after_update` can be part of a CUDA graph, see `as_cuda_graph`."""

    WRITES_LOG_PROB: ClassVar[bool] = False
    """Whether `policy` writes `action_log_prob` in addition to `action`."""

    policy: Any
    memory: Any
    """What it learns from, with `extend`, `state_dict` and `load_state_dict`."""

    def __init__(
        self,
        loss: LossModule,
        *,
        learning_rate: float,
        total_updates: int,
        tau: float | None = None,
        max_grad_norm: float | None = None,
    ) -> None:
        self.loss = loss
        if tau is not None:
            SoftUpdate(loss, tau=tau)  # keeps TorchRL from warning that nothing moves the targets
        self.tau = tau
        self.weights = weights_of(loss) | dict(self.other_weights())
        # Pairs of tensors for `after_update`: each target and the weight that it follows.
        targets = [name for name in self.weights if name.startswith("target_")]
        self._targets = [self.weights[name] for name in targets]
        self._followed = [self.weights[name.removeprefix("target_")].data for name in targets]
        self.trained = {n: w for n, w in self.weights.items() if w.requires_grad}
        self.learning_rate, self.total_updates = learning_rate, max(1, total_updates)
        self.max_grad_norm = max_grad_norm
        self.device = next(iter(self.trained.values())).device
        self.optimizer = torch.optim.Adam(
            self._parameter_groups(self.rate_factors()),
            fused=True,
            capturable=self.device.type == "cuda",
        )
        losses = [name for name in self.METRICS if name.endswith("_loss")]
        others = [name for name in self.METRICS if name not in losses]
        self.divergence = DivergenceWatch([*losses, "grad_norm"], others, self.device)
        # The fused optimizer skips its step if this is 1; it reads the value on the device.
        self.optimizer.found_inf = self.divergence.is_bad  # type: ignore[attr-defined]
        self.updates = 0
        self._is_eager = not self.CAPTURABLE
        self._capture()

    def _parameter_groups(self, rate_factors: Mapping[str, float]) -> list[dict[str, Any]]:
        groups: dict[float, dict[str, Any]] = {}
        for name, weight in self.trained.items():
            factor = rate_factors.get(name, 1.0)
            # A tensor, so that a captured step reads its current value.
            rate = torch.tensor(self.learning_rate * factor, device=self.device)
            group = groups.setdefault(factor, {"params": [], "factor": factor, "lr": rate})
            group["params"].append(weight)
        return list(groups.values())

    @classmethod
    def make_policy(
        cls,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        options: Any,
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
    ) -> Any:
        """Returns an untrained policy alone, for an agent that only acts.

        Its `state_dict` is interchangeable with that of `policy`. The arguments are those of the
        constructor of `OffPolicy`.
        """
        device = torch.device(device)
        codecs = map_codecs(observation_spec, keys, compute_dtype(options.precision, device))
        count = action_count(action_spec)
        layer_norm = getattr(options, "layer_norm", False)  # not an option of every algorithm
        with device:
            network = MapNetwork(codecs, options.hidden_size, count, layer_norm=layer_norm)
        return stochastic_policy(
            PolicyNetwork(network), list(keys), writes_log_prob=cls.WRITES_LOG_PROB
        )

    def step_eagerly(self) -> None:
        """Runs all further updates eagerly instead of as a CUDA graph, for debugging and timing."""
        self._is_eager = True
        self._capture()

    def _capture(self) -> None:
        step = self._take_step
        self._step = step if self._is_eager else as_cuda_graph(step, self.device)

    @classmethod
    def metric_names(cls) -> tuple[str, ...]:
        """Returns the names of the metrics that `update` returns."""
        return (*cls.METRICS, "grad_norm", "learning_rate")

    def act(self, observation: TensorDictBase) -> TensorDictBase:
        """Adds `action`, as taken in training, to an observation of N envs, and returns it."""
        return self.policy(observation)

    def remember(self, steps: TensorDictBase) -> None:
        """Stores steps of N envs: observations, actions, rewards and next observations."""
        self.memory.extend(steps)

    @abstractmethod
    def updates_due(self, frames: int) -> int:
        """Returns how many updates to take after `frames` frames have been stored in total."""

    @abstractmethod
    def sample(self) -> TensorDictBase:
        """Returns the batch for one update."""

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the scalars named in `METRICS`; the losses among them carry gradients."""
        out = self.loss(batch)
        return {name: out[key] for name, key in self.METRICS.items()}

    def rate_factors(self) -> Mapping[str, float]:
        """Returns factors on the learning rate, by name of the trained weight."""
        return {}

    def other_weights(self) -> Mapping[str, Tensor]:
        """Returns tensors that training changes in addition to the loss's weights, by name."""
        return {}

    def after_update(self) -> None:
        """Moves the targets by `tau` towards the weights; called after each optimizer step."""
        if self.tau is not None:
            with torch.no_grad():
                # One call for all weights; SoftUpdate's step has several for each weight.
                torch._foreach_lerp_(self._targets, self._followed, self.tau)

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Takes one update on a batch from `sample()` and returns detached metrics.

        Once a loss or a gradient is nan or infinite, the weights no longer change and
        `divergence.check()` raises.
        """
        # Not below 0: a step of all envs may go beyond the last frame and bring one more update.
        learning_rate = self.learning_rate * max(0.0, 1 - self.updates / self.total_updates)
        for group in self.optimizer.param_groups:
            group["lr"].fill_(learning_rate * group["factor"])
        metrics = dict(self._step(batch).items())
        self.updates += 1
        return metrics | {"learning_rate": torch.tensor(learning_rate)}

    def _take_step(self, batch: TensorDictBase) -> TensorDictBase:
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.losses(batch)
        minimised = [loss for name, loss in losses.items() if name.endswith("_loss")]
        torch.stack(minimised).sum().backward()  # all gradients at the same weights
        metrics = {name: value.detach() for name, value in losses.items()}
        metrics["grad_norm"] = self._gradient_norm()
        self.divergence.record(metrics)  # before the step, which is skipped if they are bad
        self.optimizer.step()
        self.after_update()
        return TensorDict(metrics, [])

    def _gradient_norm(self) -> Tensor:
        """Returns the norm over all gradients, then scales them down to `max_grad_norm`."""
        trained = self.trained.values()
        norm = torch.nn.utils.get_total_norm([w.grad for w in trained if w.grad is not None])
        if self.max_grad_norm is not None:
            torch.nn.utils.clip_grads_with_norm_(trained, self.max_grad_norm, norm)
        return norm

    def state_dict(self) -> dict[str, Any]:
        """Returns weights, Adam's moments and the number of updates, without the memory."""
        moments = {n: dict(self.optimizer.state[w]) for n, w in self.trained.items()}
        return {
            "weights": {name: weight.detach() for name, weight in self.weights.items()},
            "moments": moments if self.updates else {},
            "updates": self.updates,
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a `state_dict`, also into an agent that has learnt more since then or diverged.

        Raises:
            ValueError: another algorithm saved it, or it is for other maps or sizes.
        """
        saved = state["weights"]
        here, there = ({n: tuple(w.shape) for n, w in x.items()} for x in (self.weights, saved))
        differing = [n for n in sorted(here | there) if here.get(n) != there.get(n)]
        if differing:
            first = differing[0]
            raise ValueError(
                f"the saved agent does not fit this one in {len(differing)} weights, first "
                f"{first}: {here.get(first, 'absent')} here, {there.get(first, 'absent')} there; "
                "use the algorithm, representations, picture size and encoder it was made with"
            )
        for name, weight in self.weights.items():
            weight.copy_(saved[name])
        self.optimizer.state.clear()  # a state without updates has no moments
        for name, moments in state["moments"].items():
            copied = {key: value.to(self.device, copy=True) for key, value in moments.items()}
            self.optimizer.state[self.trained[name]] = copied
        self.updates = state["updates"]
        self.divergence.reset(self.updates)
        self._capture()  # Adam's moments are at new addresses


class OffPolicy(Algorithm):
    """Takes one update every `frames_per_update` frames, on a uniform sample of recent frames.

    Args:
        observation_spec: the last three dims of each map are C, H, W.
        action_spec: a `Categorical`.
        keys: the observation maps to read, in order.
        options: an instance of the class's `OPTIONS`.
        total_frames: frames of the whole training, at whose end the learning rate is 0.
        device: the device of networks and replay memory.
        mirror_image: for the option `mirror`, the transform that replaces half of each sampled
            batch by mirror images, such as `flowrep.transforms.Mirror`.
    """

    OPTIONS: ClassVar[type[AlgorithmOptions]] = OffPolicyOptions
    options: Any
    memory: ReplayMemory

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        options: OffPolicyOptions,
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
        mirror_image: Transform | None = None,
    ) -> None:
        self.options = options
        self.policy = self.make_policy(
            observation_spec, action_spec, keys, options, total_frames=total_frames, device=device
        )
        network = self.policy[0].module.network
        self.codecs = network.codecs
        loss = self.LOSS(network, action_count(action_spec), options)
        starts = options.learning_starts
        self.learning_starts = options.batch_size if starts is None else starts
        super().__init__(
            loss,
            tau=options.tau,
            learning_rate=options.learning_rate,
            total_updates=(total_frames - self.learning_starts) // options.frames_per_update,
        )
        self.memory = ReplayMemory(
            self.codecs,
            capacity=options.replay_capacity,
            batch_size=options.batch_size,
            device=device,
            n_steps=options.n_steps,
            gamma=options.gamma,
        )
        if options.mirror:
            if mirror_image is None:
                raise ValueError("mirror=True needs mirror_image, a transform of sampled batches")
            self.memory.append_transform(mirror_image)

    def updates_due(self, frames: int) -> int:
        """Returns how many updates are due after `frames` frames, minus those already taken."""
        allowed = max(0, frames - self.learning_starts) // self.options.frames_per_update
        return allowed - self.updates

    def sample(self) -> TensorDictBase:
        """Returns a sample of the replay memory."""
        return self.memory.sample()


def transition_keys(codecs: Sequence[MapCodec]) -> list[NestedKey]:
    """Returns the keys of a sampled transition that a loss reads."""
    maps = [codec.key for codec in codecs]
    following = [unravel_key(("next", key)) for key in (*maps, *OUTCOME)]
    return [*maps, "action", "steps_to_next_obs", *following]


def td_target(batch: TensorDictBase, next_value: Tensor, gamma: float) -> Tensor:
    """Returns r + γⁿ (1 - terminated) V(s') `[N]` of sampled transitions, given V(s') `[N, 1]`.

    In flowrep's streets every end is `terminated`, also a time-out.
    """
    outcome = batch["next"]
    # Masked instead of multiplied, because the value after an end may be nan.
    next_value = next_value.masked_fill(outcome["terminated"], 0.0)
    discount = gamma ** batch["steps_to_next_obs"]
    return (outcome["reward"] + discount * next_value).squeeze(-1)


def weights_of(loss: LossModule) -> dict[str, Tensor]:
    """Returns a loss's parameters and target parameters by name, those of the encoders first."""
    targets = {n: w for n, w in loss.named_buffers() if n.startswith("target_") and "_params." in n}
    weights = dict(loss.named_parameters()) | targets
    encoders = [name for name in weights if "encoder" in name.partition(".")[0]]
    return {name: weights[name] for name in (*encoders, *weights)}
