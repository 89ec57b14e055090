"""TorchRL's loss of discrete SAC, its Q-functions evaluated together and once."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import DiscreteSACLoss

from flowrep.agent.heads import heads_together


class DiscreteSACHeadsLoss(DiscreteSACLoss):
    """`DiscreteSACLoss` of a `Head` as policy and several as Q-functions.

    TorchRL evaluates Q1 and Q2 one after the other (or by vmap), and those of `s` twice: for L_Q
    with gradients, for L_π without. Here a hidden layer of twice the width is both, and what L_Q
    has computed L_π takes: `qvalue_loss` goes first, `actor_loss` follows on the same batch.
    """

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = self._action_values
        self._of_this_batch: Tensor | None = None

    def _action_values(self, maps: TensorDictBase, params: Any) -> TensorDictBase:
        """Returns a TensorDict with the action values `[nets, N, n]` of all Q-functions."""
        (key,) = self.qvalue_network.in_keys
        if params is self._cached_detached_qvalue_params and self._of_this_batch is not None:
            values, self._of_this_batch = self._of_this_batch, None
        else:
            values = heads_together(maps[key], params["module"])
            if params is self.qvalue_network_params:
                self._of_this_batch = values.detach()
        return TensorDict({self.tensor_keys.action_value: values}, values.shape[:2])
