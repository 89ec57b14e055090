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
from flowrep.agent.map_codec import MapCodec, decode_maps, store_maps
from flowrep.agent.networks import Encoder, Head, MapNetwork, action_count, stochastic_policy
from flowrep.agent.replay import OUTCOME, time_first
from flowrep.config.algorithms import PPOOptions


class Rollout:
    """Keeps steps of N envs until `clear`, with their stored maps and next maps."""

    def __init__(self, codecs: Sequence[MapCodec], device: torch.device) -> None:
        self.codecs, self.device = tuple(codecs), device
        self._steps: list[TensorDictBase] = []

    def __len__(self) -> int:
        """Returns the number of steps of each env."""
        return len(self._steps)

    def extend(self, frames: TensorDictBase) -> None:
        """Stores steps of N envs, with dims as in `time_first`."""
        for step in time_first(frames).unbind(0):
            kept = store_maps(self.codecs, step)
            kept.update(step.select("action", "action_log_prob").detach())
            # With the next maps, because after a truncated step the next row is of another episode.
            outcome = step["next"].select(*OUTCOME)
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
        """Restores a `state_dict`."""
        self.clear()
        if state["length"]:
            shape = [state["length"], len(state["steps"]["action"][0])]
            steps = TensorDict(state["steps"], shape).to(self.device)
            steps["next"].batch_size = steps.batch_size
            self._steps = list(steps.unbind(0))


class ClipPPOMapLoss(ClipPPOLoss):
    """TorchRL's clipped loss on stored maps, with one encoder for policy and V; see `PPO`."""

    encoder: Encoder
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(self, network: MapNetwork, num_actions: int, options: PPOOptions) -> None:
        with next(network.parameters()).device:
            critic = Head(network.encoder.embedding_size, network.hidden_size, 1)
        super().__init__(
            stochastic_policy(network.head, ["embedding"]),
            TensorDictModule(critic, ["embedding"], ["state_value"]),
            clip_epsilon=options.clip,
            entropy_coeff=options.entropy_weight,
            critic_coeff=options.value_weight,
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
        read = ("action", "action_log_prob", "advantage", "value_target")
        embedded = tensordict.select(*read).set("embedding", self.embed(tensordict))
        out = super().forward(embedded)
        return out.set("explained_variance", out["explained_variance"].squeeze())

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        # TorchRL's version makes the host wait for a check, which the divergence watch replaces.
        return dist.entropy().unsqueeze(-1)


class PPO(Algorithm):
    """Policy and state-value function on one set of encoders, learning on-policy.

    After every `rollout_length` steps of each env, a round of updates makes `epochs` passes over
    these steps in shuffled batches. Advantages Â (generalised, then normalised over the batch) and
    value targets R are computed with the weights at the beginning of the round. With
    ρ = π(a|s) / π_acted(a|s), where π_acted(a|s) was stored when a was drawn, one update minimises,
    over a batch,

        L_π = -mean min(ρ Â, clip(ρ, 1 - clip, 1 + clip) Â)
        L_V = value_weight · mean (V(s) - R)²
        L_H = entropy_weight · mean Σ_a π(a|s) log π(a|s)

    The arguments are those of `OffPolicy`, without `mirror_image`.
    """

    OPTIONS = PPOOptions
    WRITES_LOG_PROB = True
    LOSS = ClipPPOMapLoss
    METRICS: ClassVar = {
        "policy_loss": "loss_objective", "value_loss": "loss_critic",
        "entropy_loss": "loss_entropy", "entropy": "entropy", "kl": "kl_approx",
        "clip_share": "clip_fraction", "explained_variance": "explained_variance",
    }  # fmt: skip
    memory: Rollout

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        options: PPOOptions,
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.options, self.num_envs = options, observation_spec.shape.numel()
        _, frames_per_round = options.first_update(self.num_envs)
        rounds = total_frames // frames_per_round
        self.policy = self.make_policy(
            observation_spec, action_spec, keys, options, total_frames=total_frames, device=device
        )
        network = self.policy[0].module.network
        discounts = {"gamma": options.gamma, "lmbda": options.gae_lambda}
        self._advantage = GAE(**discounts, value_network=None, device=device)
        self.codecs = network.codecs
        self.memory = Rollout(self.codecs, torch.device(device))
        self._round: TensorDictBase = TensorDict()  # the steps in training, [n]
        self._batches: list[Tensor] = []  # rows of the round's remaining batches
        super().__init__(
            self.LOSS(network, action_count(action_spec), options),
            learning_rate=options.learning_rate,
            total_updates=rounds * self._updates_of(options.rollout_length),
            max_grad_norm=options.max_grad_norm,
        )

    def _updates_of(self, steps: int) -> int:
        return self.options.epochs * (steps * self.num_envs // self.options.batch_size)

    def updates_due(self, frames: int) -> int:
        """Returns the number of updates of one round if a rollout is complete, else 0."""
        steps = len(self.memory)
        return 0 if steps < self.options.rollout_length else self._updates_of(steps)

    def sample(self) -> TensorDictBase:
        """Returns the round's next batch; the first call begins the round and clears the memory."""
        if not self._batches:
            self._round = self._with_advantages(self.memory.steps()).reshape(-1)
            self.memory.clear()  # each frame belongs to one round
            size = self.options.batch_size
            for _ in range(self.options.epochs):
                # Shuffled, as neighbouring steps are alike: batches in their order are biased.
                rows = torch.randperm(len(self._round)).split(size)
                self._batches += [r for r in rows if len(r) == size]
        return self._round[self._batches.pop(0).to(self._round["action"].device)]

    @torch.no_grad()
    def _with_advantages(self, steps: TensorDictBase) -> TensorDictBase:
        """Adds `advantage` and `value_target`, by the current weights, to steps `[N, T]`."""
        for observed in (steps, steps["next"]):
            # In batches as large as those of updates, which bounds the memory.
            parts = observed.reshape(-1).split(self.options.batch_size)
            values = torch.cat([self.loss.state_value(part) for part in parts])
            observed["state_value"] = values.reshape(*steps.shape, 1)
        return self._advantage(steps)
