"""How well a policy drives: outcomes of whole episodes, with intervals."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from statistics import NormalDist

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.envs import Outcome
from flowrep.envs.outcome import hit_name

Policy = Callable[[TensorDictBase], TensorDictBase]

OUTCOMES = tuple(outcome.label for outcome in Outcome)
"""Names of the env's `outcome` codes; each one but the first ends an episode."""


@dataclass(frozen=True)
class Episode:
    """One finished episode: which it was, how it ended, what was hit, return, length in steps."""

    episode_seed: int
    outcome: str
    hit: str
    total_reward: float
    length: int


def quotas(episodes: int, num_envs: int) -> list[int]:
    """Returns how many episodes each environment runs, the first ones one more if need be.

    >>> quotas(5, 3)
    [2, 2, 1]
    """
    return [episodes // num_envs + (i < episodes % num_envs) for i in range(num_envs)]


def run_episodes(
    env: EnvBase, policy: Policy, episodes: int, *, seed: int, greedy: bool = True
) -> Iterator[Episode]:
    """Yields `episodes` finished episodes of `policy`, as they end, the same for every policy.

    Environment i of the batch, seeded by `seed + i`, runs its own first episodes, as many as any
    other, so that short episodes are not overrepresented.

    Args:
        env: batched TorchRL env with `outcome`, `hit` and `episode_seed` in its TensorDict.
        policy: writes `action`.
        episodes: how many episodes to run.
        seed: of the environments.
        greedy: most probable action, else a sampled one.
    """
    num_envs = env.batch_size.numel()
    left = quotas(episodes, num_envs)
    total_reward = torch.zeros(num_envs)
    length = torch.zeros(num_envs, dtype=torch.long)
    mode = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
    env.set_seed(seed)
    tensordict = env.reset()
    while any(left):
        with torch.no_grad(), set_exploration_type(mode):
            stepped, tensordict = env.step_and_maybe_reset(policy(tensordict))
        after = stepped["next"].cpu()
        total_reward += after["reward"].reshape(-1)
        length += 1
        for i in after["done"].reshape(-1).nonzero().flatten().tolist():
            if left[i]:
                left[i] -= 1
                yield Episode(
                    int(after["episode_seed"].reshape(-1)[i]),
                    OUTCOMES[int(after["outcome"].reshape(-1)[i])],
                    hit_name(int(after["hit"].reshape(-1)[i])),
                    float(total_reward[i]),
                    int(length[i]),
                )
            total_reward[i], length[i] = 0.0, 0


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's score interval of a proportion; (0, 1) without trials.

    >>> low, high = wilson_interval(8, 10)
    >>> round(low, 3), round(high, 3)
    (0.49, 0.943)
    """
    if not trials:
        return 0.0, 1.0
    z2 = NormalDist().inv_cdf(0.5 + confidence / 2) ** 2
    share = successes / trials
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = (z2 * share * (1 - share) / trials + z2**2 / (4 * trials**2)) ** 0.5 / (1 + z2 / trials)
    # Rounding may leave the exact ends 0 and 1 by an ulp.
    return max(0.0, centre - half), min(1.0, centre + half)


def outcome_shares(outcomes: Iterable[str]) -> dict[str, tuple[float, float, float]]:
    """Returns for each way to end an episode its share with its 95 % Wilson interval."""
    counts = Counter(outcomes)
    trials = counts.total()
    return {
        name: (counts[name] / max(trials, 1), *wilson_interval(counts[name], trials))
        for name in OUTCOMES[1:]
    }
