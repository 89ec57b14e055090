"""What training asks of an algorithm, and what every algorithm here does in the same way."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.objectives import LossModule, SoftUpdate

from flowrep.agent.action import DiscreteActions
from flowrep.agent.cuda_graph import as_cuda_graph
from flowrep.agent.divergence import DivergenceWatch
from flowrep.agent.options import options_of
from flowrep.agent.policy import acting_network, stochastic_policy


class Memory(Protocol):
    """What an algorithm keeps of the frames that it has seen."""

    def extend(self, frames: TensorDictBase) -> object:
        """Stores steps of N environments."""

    def state_dict(self) -> dict[str, Any]:
        """Returns all that it holds."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`."""


class Algorithm(ABC):
    """Acts by `policy`, keeps frames in `memory`, and takes gradient steps on samples of it.

    ```
    acted = algorithm.policy(observation)                   # writes `action`
    for _ in range(algorithm.updates_due(frames)):
        metrics = algorithm.update(algorithm.sample())
    algorithm.remember(steps)                               # with what the action brought
    ```

    What is minimised is a TorchRL `LossModule`; this class has the rest of an update: schedule,
    Adam, targets, CUDA graph, the watch for divergence. A subclass sets `policy` (by
    `make_policy`, which makes it for evaluation too) and `memory`, calls this constructor with its
    loss, and writes `sample` and `updates_due`. Everything it needs to continue then lies in the
    loss's weights, the memory and Adam's state, which are saved.

    Args:
        loss: its parameters are trained, its target parameters follow them.
        learning_rate: Adam's, falling linearly to 0 over `total_updates`.
        total_updates: gradient steps of the whole training.
        tau: share of the online weights in each move of the targets; None if there are none.
        max_grad_norm: gradients of a larger norm, all weights together, are scaled down to it.
        rate_factors: by the name of a trained weight, by how much its learning rate differs.
    """

    METRICS: ClassVar[Mapping[str, str]]
    """What is logged, with the key under which the loss returns it; those that end in `_loss` are
    minimised, as a sum."""

    LOSS: ClassVar[Callable[..., LossModule]]
    """Makes the loss, of the policy's `MapNetwork` and its `DiscreteActions`."""

    CAPTURABLE: ClassVar[bool] = True
    """Whether `losses` and `after_update` can be part of a CUDA graph, see `as_cuda_graph`."""

    WRITES_LOG_PROB: ClassVar[bool] = False
    """Whether `policy` writes `action_log_prob` beside `action`."""

    policy: Any
    memory: Memory

    def __init__(
        self,
        loss: LossModule,
        *,
        learning_rate: float,
        total_updates: int,
        tau: float | None = None,
        max_grad_norm: float | None = None,
        rate_factors: Mapping[str, float] | None = None,
    ) -> None:
        self.loss = loss
        self.target_updater = None if tau is None else SoftUpdate(loss, tau=tau)
        self.weights = weights_of(loss) | dict(self.other_weights())
        self.trained = {n: w for n, w in self.weights.items() if w.requires_grad}
        self.learning_rate, self.total_updates = learning_rate, max(1, total_updates)
        self.max_grad_norm = max_grad_norm
        self.device = next(iter(self.trained.values())).device
        self.optimizer = torch.optim.Adam(
            self._parameter_groups(rate_factors or {}),
            fused=True,
            capturable=self.device.type == "cuda",
        )
        losses = [name for name in self.METRICS if name.endswith("_loss")]
        others = [name for name in self.METRICS if name not in losses]
        self.divergence = DivergenceWatch([*losses, "grad_norm"], others, self.device)
        # the fused step takes no step where it is 1, and asks the device, not the host
        self.optimizer.found_inf = self.divergence.is_bad  # type: ignore[attr-defined]
        self.updates = 0
        self._is_eager = not self.CAPTURABLE
        self._capture()

    def _parameter_groups(self, rate_factors: Mapping[str, float]) -> list[dict[str, Any]]:
        """Returns Adam's groups: the weights that share a learning rate."""
        unknown = rate_factors.keys() - self.trained.keys()
        if unknown:
            raise ValueError(f"rate_factors names {sorted(unknown)}, which training doesn't change")
        groups: dict[float, list[Tensor]] = {}
        for name, weight in self.trained.items():
            groups.setdefault(rate_factors.get(name, 1.0), []).append(weight)
        # rates are tensors, so that a captured step reads what they are set to
        return [
            {
                "params": weights,
                "factor": factor,
                "lr": torch.tensor(self.learning_rate * factor, device=self.device),
            }
            for factor, weights in groups.items()
        ]

    @classmethod
    def make_policy(
        cls,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        device: torch.device | str,
        **options: Any,
    ) -> Any:
        """Returns the acting side alone, untrained: what an agent needs that learns no more.

        Its `state_dict` is that of `policy`, and the weights of the one fit the other.

        Args:
            observation_spec: the environment's.
            action_spec: `Categorical` or `OneHot`.
            keys: the observation maps to read, in order.
            device: where its networks live.
            options: those of the constructor, `precision` and `hidden_size` among them; what acting
                doesn't depend on is not looked at.
        """
        network = acting_network(
            observation_spec,
            action_spec,
            keys,
            device=torch.device(device),
            precision=options["precision"],
            hidden_size=options["hidden_size"],
            layer_norm=options.get("layer_norm", False),  # not every algorithm has the choice
        )
        actions = DiscreteActions.from_spec(action_spec)
        return stochastic_policy(network, list(keys), actions, writes_log_prob=cls.WRITES_LOG_PROB)

    @classmethod
    def options(cls) -> dict[str, inspect.Parameter]:
        """Returns what a config may set, by name.

        These are the parameters of the class; where it takes any keyword, those of its bases and
        of its loss too.
        """
        owners = [owner for owner in cls.__mro__ if "__init__" in vars(owner)]
        return options_of([*owners[: owners.index(Algorithm)], getattr(cls, "LOSS", None)])

    def step_eagerly(self) -> None:
        """Takes every further update operation by operation, never as a CUDA graph.

        For debugging and for timing: the numbers are the same.
        """
        self._is_eager = True
        self._capture()

    def _capture(self) -> None:
        step = self._take_step
        self._step = step if self._is_eager else as_cuda_graph(step, self.device)

    @classmethod
    def metric_names(cls) -> tuple[str, ...]:
        """Returns the keys of what `update` returns."""
        return (*cls.METRICS, "grad_norm", "learning_rate")

    def remember(self, steps: TensorDictBase) -> None:
        """Takes in steps of N environments: observations, actions and what they brought."""
        self.memory.extend(steps)

    @abstractmethod
    def updates_due(self, frames: int) -> int:
        """Returns how many updates to take, now that `frames` have been remembered in all."""

    @abstractmethod
    def sample(self) -> TensorDictBase:
        """Returns the batch for one update."""

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the scalars named in `METRICS`, the losses among them with gradients."""
        out = self.loss(batch)
        return {name: out[key] for name, key in self.METRICS.items()}

    def other_weights(self) -> Mapping[str, Tensor]:
        """Returns what training changes beside the weights of the loss, by name."""
        return {}

    def after_update(self) -> None:
        """Follows each step of the optimizer: moves the targets by `tau` of their distance."""
        if self.target_updater is not None:
            self.target_updater.step()

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Takes one gradient step on a batch from `sample()`; returns detached metrics.

        From the first update on in which a loss or a gradient is nan or infinite, the weights stay
        as they are and `divergence.check()` raises.
        """
        learning_rate = self.learning_rate * max(0.0, 1 - self.updates / self.total_updates)
        for group in self.optimizer.param_groups:
            group["lr"].fill_(learning_rate * group["factor"])
        metrics = dict(self._step(batch).items())
        self.updates += 1
        return metrics | {"learning_rate": torch.tensor(learning_rate)}

    def _take_step(self, batch: TensorDictBase) -> TensorDictBase:
        """Does on the device all that an update does; returns the metrics."""
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.losses(batch)
        minimised = [loss for name, loss in losses.items() if name.endswith("_loss")]
        torch.stack(minimised).sum().backward()
        metrics = {name: value.detach() for name, value in losses.items()}
        metrics["grad_norm"] = self._gradient_norm()
        self.divergence.look(metrics)
        self.optimizer.step()
        self.after_update()
        return TensorDict(metrics, [])

    def _gradient_norm(self) -> Tensor:
        """Returns the norm of all gradients, which it then scales down to `max_grad_norm`."""
        trained = [w for w in self.trained.values() if w.grad is not None]
        norm = torch.nn.utils.get_total_norm([w.grad for w in trained if w.grad is not None])
        if self.max_grad_norm is not None:
            torch.nn.utils.clip_grads_with_norm_(trained, self.max_grad_norm, norm)
        return norm

    def state_dict(self) -> dict[str, Any]:
        """Returns weights, Adam's moments and the schedule's position; not the memory."""
        moments = {n: dict(self.optimizer.state[w]) for n, w in self.trained.items()}
        return {
            "weights": {name: weight.detach() for name, weight in self.weights.items()},
            "moments": moments if self.updates else {},
            "updates": self.updates,
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`.

        Raises:
            ValueError: if it belongs to another algorithm, or to other maps or sizes.
        """
        saved = state["weights"]
        shapes = {name: tuple(weight.shape) for name, weight in self.weights.items()}
        differing = [
            f"{name}: {shapes.get(name, 'absent')} here, "
            f"{tuple(saved[name].shape) if name in saved else 'absent'} there"
            for name in sorted(shapes.keys() | saved.keys())
            if name not in saved or shapes.get(name) != tuple(saved[name].shape)
        ]
        if differing:
            raise ValueError(
                f"the saved agent does not fit this one in {len(differing)} weights, first "
                f"{differing[0]}; use the algorithm, representations, image size and encoder it "
                "was made with"
            )
        for name, weight in self.weights.items():
            weight.copy_(saved[name])
        for name, moments in state["moments"].items():
            weight = self.trained[name]
            self.optimizer.state[weight] = {
                key: value.to(weight.device, copy=True) for key, value in moments.items()
            }
        self.updates = state["updates"]
        self._capture()  # Adam's moments lie elsewhere now


def weights_of(loss: LossModule) -> dict[str, Tensor]:
    """Returns a loss's parameters and target parameters by name, those of encoders first."""
    targets = {n: w for n, w in loss.named_buffers() if n.startswith("target_") and "_params." in n}
    weights = dict(loss.named_parameters()) | targets
    encoders = [name for name in weights if "encoder" in name.partition(".")[0]]
    return {name: weights[name] for name in (*encoders, *weights)}
