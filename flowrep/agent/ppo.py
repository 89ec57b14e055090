"""Proximal policy optimisation from maps, with TorchRL's clipped loss and GAE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import Composite, TensorSpec
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from flowrep.agent.algorithm import Algorithm
from flowrep.agent.networks import DiscreteActions, Encoder, Head, MapNetwork, stochastic_policy
from flowrep.agent.observation import MapCodec, compute_dtype, decode_maps, map_codecs, store_maps
from flowrep.agent.replay import time_first


class Rollout:
    """Keeps steps of N environments until `clear`, with their stored maps and next maps.

    Args:
        codecs: the maps to keep; see `flowrep.agent.observation`.
        device: where they are kept.
        extra_keys: entries kept besides the maps, `action` and its outcome.
    """

    def __init__(
        self,
        codecs: Sequence[MapCodec],
        device: torch.device | str,
        extra_keys: Sequence[NestedKey] = (),
    ) -> None:
        self.codecs, self.device = tuple(codecs), torch.device(device)
        self._keys = ("action", *extra_keys)
        self._steps: list[TensorDictBase] = []

    def __len__(self) -> int:
        """Returns the number of steps of each environment."""
        return len(self._steps)

    def numel(self) -> int:
        """Returns the number of steps of all environments."""
        return sum(step.numel() for step in self._steps)

    def extend(self, frames: TensorDictBase) -> None:
        """Stores steps of N environments: `[N]`, `[N, T]`, or as a TorchRL collector returns them.

        Args:
            frames: with the maps, `action`, `extra_keys` and, under `next`, the maps, `reward`,
                `done` and `terminated`. A dim named `time` is the time dim; without one, a single
                dim is N.
        """
        for step in time_first(frames).unbind(0):
            kept = store_maps(self.codecs, step).update(step.select(*self._keys).detach())
            outcome = step["next"].select("reward", "done", "terminated")
            kept["next"] = store_maps(self.codecs, step["next"]).update(outcome)
            self._steps.append(kept.to(self.device))

    def steps(self) -> TensorDictBase:
        """Returns all steps as `[N, T]`, the last dim named `time`."""
        steps: TensorDictBase = TensorDict.stack(self._steps, 1)
        steps.names = [None, "time"]
        return steps

    def clear(self) -> None:
        """Forgets all steps."""
        self._steps = []

    def state_dict(self) -> dict[str, Any]:
        """Returns the steps."""
        stacked = TensorDict.stack(self._steps).to_dict() if self._steps else None
        return {"length": len(self._steps), "steps": stacked}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`.

        Raises:
            ValueError: if an entry that this rollout keeps is missing.
        """
        self.clear()
        if state["length"]:
            missing = [key for key in self._keys if key not in state["steps"]]
            if missing:
                raise ValueError(
                    f"the saved rollout lacks {missing[0]!r}: the checkpoint is of an older "
                    "version, start the run anew"
                )
            width = len(state["steps"]["action"][0])
            steps = TensorDict(state["steps"], [state["length"], width]).to(self.device)
            steps["next"].batch_size = steps.batch_size
            self._steps = list(steps.unbind(0))


class ClipPPOMapLoss(ClipPPOLoss):
    """TorchRL's clipped loss on stored maps, with one encoder for policy and V; see `PPO`.

    TorchRL makes the host wait to check that the entropy is finite. Here the divergence check
    covers it, see `Algorithm.update`.

    Args:
        network: the policy's; V shares its encoder.
        actions: the policy's action space.
        clip: distance of ρ from 1 beyond which the objective no longer rewards moving it.
        value_weight: weight of L_V.
        entropy_weight: weight of L_H.
    """

    encoder: Encoder
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(
        self,
        network: MapNetwork,
        actions: DiscreteActions,
        *,
        clip: float = 0.2,
        value_weight: float = 0.5,
        entropy_weight: float = 0.01,
    ) -> None:
        with next(network.parameters()).device:
            critic = Head(network.encoder.embedding_size, network.hidden_size, 1)
        super().__init__(
            stochastic_policy(network.head, ["embedding"], actions),
            TensorDictModule(critic, ["embedding"], ["state_value"]),
            clip_epsilon=clip,
            entropy_coeff=entropy_weight,
            critic_coeff=value_weight,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.codecs = network.codecs
        self.convert_to_functional(network.encoder, "encoder")

    def embed(self, maps: TensorDictBase) -> Tensor:
        """Returns the embeddings of stored maps."""
        return self.encoder(decode_maps(self.codecs, maps))

    def state_value(self, maps: TensorDictBase) -> Tensor:
        """Returns V `[n, 1]` for stored maps."""
        embedded = TensorDict({"embedding": self.embed(maps)}, maps.batch_size)
        return self.critic_network(embedded)["state_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the losses of a batch, with gradients, and further metrics, without."""
        noted = ("action", "action_log_prob", "advantage", "value_target")
        embedded = tensordict.select(*noted).set("embedding", self.embed(tensordict))
        out = super().forward(embedded)
        return out.set("explained_variance", out["explained_variance"].squeeze())

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        return dist.entropy().unsqueeze(-1)


class PPO(Algorithm):
    """Policy and state-value function on one set of encoders, learning on-policy.

    After every `rollout_length` steps of each environment, `epochs` passes are made over those
    steps in shuffled batches. Advantages Â (generalised, then normalised over the batch) and value
    targets R come from the weights at the beginning of the round. One gradient step minimises, over
    a batch and with ρ = π(a|s) / π_acted(a|s), where π_acted(a|s) was recorded when a was drawn,

        L_π = -mean min(ρ Â, clip(ρ, 1 - clip, 1 + clip) Â)
        L_V = value_weight · mean (V(s) - R)²
        L_H = entropy_weight · mean Σ_a π(a|s) log π(a|s)

    Args:
        observation_spec: the environment's; the last three dims of each map are C, H, W, the
            dims before them are the environments.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames over the whole training, after which the learning rate
            is 0.
        device: where networks, rollout and updates live.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: Adam's, falling linearly to 0.
        rollout_length: steps of each environment between two rounds of learning.
        epochs: passes over them.
        batch_size: steps per update; an incomplete last batch is left out of its pass.
        gamma: discount per frame.
        gae_lambda: GAE's λ, from 0 (relies on V) to 1 (relies on the rewards).
        max_grad_norm: the norm over all gradients is scaled down to this maximum.
        hidden_size: width of the single hidden layer after the embeddings.
        loss_options: further arguments of `ClipPPOMapLoss`.
    """

    WRITES_LOG_PROB = True
    LOSS = ClipPPOMapLoss
    METRICS: ClassVar[Mapping[str, str]] = {
        "policy_loss": "loss_objective",
        "value_loss": "loss_critic",
        "entropy_loss": "loss_entropy",
        "entropy": "entropy",
        "kl": "kl_approx",
        "clip_share": "clip_fraction",
        "explained_variance": "explained_variance",
    }
    memory: Rollout

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
        precision: str = "auto",
        learning_rate: float = 3e-4,
        rollout_length: int = 64,
        epochs: int = 4,
        batch_size: int = 256,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        max_grad_norm: float = 0.5,
        hidden_size: int = 512,
        **loss_options: Any,
    ) -> None:
        device = torch.device(device)
        self.codecs = map_codecs(observation_spec, keys, compute_dtype(precision, device))
        num_envs = observation_spec.shape.numel()
        self.rollout_length, self.epochs, self.batch_size = rollout_length, epochs, batch_size
        frames_per_round = rollout_length * num_envs
        if batch_size > frames_per_round:
            raise ValueError(
                f"batch_size={batch_size} is more than the {frames_per_round} frames of a rollout "
                f"({rollout_length} steps of {num_envs} environments): raise rollout_length or "
                "num_envs, or lower batch_size"
            )
        self.policy = self.make_policy(
            observation_spec,
            action_spec,
            keys,
            device=device,
            precision=precision,
            hidden_size=hidden_size,
        )
        network, actions = self.policy[0].module.network, DiscreteActions.from_spec(action_spec)
        self._advantage = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, device=device)
        self.memory = Rollout(self.codecs, device, extra_keys=["action_log_prob"])
        self._round: TensorDictBase = TensorDict()  # the steps in training, [n]
        self._batches: list[Tensor] = []  # rows of the batches to come
        super().__init__(
            self.LOSS(network, actions, **loss_options),
            learning_rate=learning_rate,
            total_updates=total_frames // frames_per_round * self._updates_of(frames_per_round),
            max_grad_norm=max_grad_norm,
        )

    def _updates_of(self, steps: int) -> int:
        return self.epochs * (steps // self.batch_size)

    def updates_due(self, frames: int) -> int:
        """Returns the number of updates of one round if a rollout is complete, else 0."""
        if len(self.memory) < self.rollout_length:
            return 0
        return self._updates_of(self.memory.numel())

    def sample(self) -> TensorDictBase:
        """Returns the round's next batch; the first call begins the round and clears the memory."""
        if not self._batches:
            self._round = self._with_advantages(self.memory.steps()).reshape(-1)
            self.memory.clear()
            for _ in range(self.epochs):
                rows = torch.randperm(len(self._round)).split(self.batch_size)
                self._batches += [r for r in rows if len(r) == self.batch_size]
        return self._round[self._batches.pop(0).to(self._round["action"].device)]

    @torch.no_grad()
    def _with_advantages(self, steps: TensorDictBase) -> TensorDictBase:
        """Returns steps `[N, T]` with `advantage` and `value_target`."""
        judged = [self._judge(part) for part in steps.reshape(-1).split(self.batch_size)]
        steps = steps.update(torch.cat(judged).reshape(steps.shape))
        return self._advantage(steps)

    def _judge(self, steps: TensorDictBase) -> TensorDictBase:
        """Returns V and V' of the steps under the current weights."""
        value = self.loss.state_value
        judged = steps.empty().update({"state_value": value(steps)})
        judged["next"] = steps["next"].empty().update({"state_value": value(steps["next"])})
        return judged
