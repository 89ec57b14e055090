"""How well a policy drives: outcomes of whole episodes, with intervals."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

Policy = Callable[[TensorDictBase], TensorDictBase]

OUTCOMES = ("running", "success", "collision", "out_of_bounds", "timeout")
"""Names of the env's `outcome` codes; each one but the first ends an episode."""


@dataclass(frozen=True)
class Episode:
    """One finished episode: which one it was, how it ended, its return and its length in steps."""

    episode_seed: int
    outcome: str
    total_reward: float
    length: int


@torch.no_grad()
def run_episodes(
    env: EnvBase,
    policy: Policy,
    episodes: int,
    *,
    greedy: bool = True,
    should_stop: Callable[[], bool] = lambda: False,
    on_episode: Callable[[], None] = lambda: None,
) -> list[Episode]:
    """Returns `episodes` finished episodes of `policy`, the same ones for every policy.

    Environment i of the batch runs its own first episodes, as many as any other (the first
    environments one more where the numbers don't divide), so short episodes are not
    overrepresented. Seed the env before to choose the episodes.

    Args:
        env: batched TorchRL env with `outcome` and `episode_seed` in its TensorDict.
        policy: writes `action`.
        episodes: how many episodes to run.
        greedy: most probable action, else a sampled one.
        should_stop: asked between steps; what has finished by then is returned.
        on_episode: called after each finished episode.
    """
    num_envs = env.batch_size.numel()
    quota = [episodes // num_envs + (i < episodes % num_envs) for i in range(num_envs)]
    finished: list[list[Episode]] = [[] for _ in range(num_envs)]
    total_reward = torch.zeros(num_envs)
    length = torch.zeros(num_envs, dtype=torch.long)
    mode = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
    tensordict = env.reset()
    with set_exploration_type(mode):
        while any(len(f) < q for f, q in zip(finished, quota)) and not should_stop():
            stepped, tensordict = env.step_and_maybe_reset(policy(tensordict))
            after = stepped["next"]
            total_reward += after["reward"].reshape(-1).cpu()
            length += 1
            for i in after["done"].reshape(-1).nonzero().flatten().tolist():
                if len(finished[i]) < quota[i]:
                    finished[i].append(
                        Episode(
                            int(after["episode_seed"].reshape(-1)[i]),
                            OUTCOMES[int(after["outcome"].reshape(-1)[i])],
                            float(total_reward[i]),
                            int(length[i]),
                        )
                    )
                    on_episode()
                total_reward[i], length[i] = 0.0, 0
    return [episode for of_env in finished for episode in of_env]


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


def success_share(episodes: Sequence[Episode]) -> float:
    """Returns the share of episodes that reached the ending zone; nan without episodes."""
    if not episodes:
        return float("nan")
    return sum(episode.outcome == "success" for episode in episodes) / len(episodes)
