"""Recent statistics of a training: finished episodes, and updates since the last row."""

import math
from collections import deque
from collections.abc import Mapping
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flowrep.experiment.evaluation import OUTCOMES

RECENT_EPISODES = 100


class RecentEpisodes:
    """Outcomes, returns and lengths of the latest finished episodes of all environments."""

    def __init__(self) -> None:
        """Starts without episodes."""
        self._running: Tensor | None = None  # [2, num_envs]: return and length so far
        self._ended: deque[tuple[int, float, int]] = deque(maxlen=RECENT_EPISODES)

    def add(self, stepped: TensorDictBase) -> None:
        """Adds a step of every environment, `[num_envs]`, as the env returned it."""
        after = stepped["next"]
        rewards = after["reward"].flatten().double()
        if self._running is None:
            self._running = torch.zeros(2, *rewards.shape, dtype=torch.float64)
        self._running = self._running.to(rewards.device)
        self._running += torch.stack([rewards, torch.ones_like(rewards)])
        done = after["done"].flatten()
        outcomes = after["outcome"].flatten()[done].tolist()
        if outcomes:
            returns, lengths = self._running[:, done].tolist()
            self._ended.extend(zip(outcomes, returns, map(int, lengths)))
            self._running[:, done] = 0.0

    def summary(self) -> dict[str, float]:
        """Returns the share of each outcome, mean return and mean length; nan without episodes."""
        if not self._ended:
            return dict.fromkeys([*OUTCOMES[1:], "return", "length"], math.nan)
        outcomes, returns, lengths = zip(*self._ended)
        shares = {
            name: outcomes.count(code) / len(outcomes) for code, name in enumerate(OUTCOMES) if code
        }
        return shares | {"return": fmean(returns), "length": fmean(lengths)}

    def state(self) -> dict[str, Any]:
        """Returns the state that `restore` takes."""
        running = torch.zeros(2, 0) if self._running is None else self._running
        return {"running": running, "ended": [list(episode) for episode in self._ended]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state`."""
        running = state["running"]
        self._running = running.clone() if running.numel() else None
        self._ended.clear()
        self._ended.extend(
            (int(code), total, int(length)) for code, total, length in state["ended"]
        )


class Means:
    """Means of the updates' metrics since the last row, without waiting for a device."""

    def __init__(self) -> None:
        """Starts without updates."""
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Adds the metrics of one update."""
        if not self._count:
            self._sums = {name: value.detach().clone() for name, value in metrics.items()}
        else:
            for name, value in metrics.items():
                # not in place, as restored sums are on the CPU
                self._sums[name] = self._sums[name] + value.detach()
        self._count += 1

    def take(self) -> dict[str, float]:
        """Returns the means, none without an update, and starts again."""
        means = {name: float(total) / self._count for name, total in self._sums.items()}
        self._sums, self._count = {}, 0
        return means

    def state(self) -> dict[str, Any]:
        """Returns the state that `restore` takes."""
        return {"sums": dict(self._sums), "count": self._count}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state`."""
        self._sums = {name: total.clone() for name, total in state["sums"].items()}
        self._count = state["count"]
