"""The training loop: act, store, learn; at intervals log, evaluate and save."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from flowrep.agent import (
    Algorithm,
    DivergenceError,
    load_checkpoint,
    save_checkpoint,
)
from flowrep.envs import begin_step, get_states, has_spare_cores, set_states
from flowrep.experiment.evaluation import OUTCOMES
from flowrep.experiment.run import RunFolder, check_origin
from flowrep.progress import Every, StopRequest, Stopwatch

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


@dataclass
class Training:
    """Everything that a run resumes from; `state` and `restore` are its checkpoint.

    Args:
        env: batched TorchRL env.
        agent: the algorithm and its memory.
        run: the folder that the run writes to.
        origin: the identity of the run that its checkpoints belong to, see `origin_of`.
        frames: environment frames so far.
        evaluation_pending: whether the last evaluation was interrupted and has to be run again.
        observation: what the policy acts on next; None before the first reset.
        metrics: means over the updates since the last row of metrics.csv.
        recent: the latest episodes that ended.
    """

    env: EnvBase
    agent: Algorithm
    run: RunFolder
    origin: Mapping[str, Any]
    frames: int = 0
    evaluation_pending: bool = False
    observation: TensorDictBase | None = None
    metrics: Means = field(default_factory=Means)
    recent: RecentEpisodes = field(default_factory=RecentEpisodes)

    def state(self) -> dict[str, Any]:
        """Returns everything that the rest of the run depends on: nested plain data and tensors."""
        assert self.observation is not None
        return {
            "origin": self.origin,
            "frames": self.frames,
            "evaluation_pending": self.evaluation_pending,
            "metrics": self.metrics.state(),
            "recent": self.recent.state(),
            "observation": self.observation.to_dict(),
            "policy": dict(self.agent.policy.state_dict()),
            "agent": self.agent.state_dict(),
            "memory": self.agent.memory.state_dict(),
            "env": get_states(self.env),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state`."""
        self.env.reset()
        self.frames = state["frames"]
        self.evaluation_pending = state["evaluation_pending"]
        self.metrics.restore(state["metrics"])
        self.recent.restore(state["recent"])
        self.observation = TensorDict(
            state["observation"], self.env.batch_size, device=self.env.device
        )
        self.agent.load_state_dict(state["agent"])
        self.agent.memory.load_state_dict(state["memory"])
        set_states(self.env, state["env"])
        torch.set_rng_state(state["torch_rng"])
        if len(state["cuda_rng"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda_rng"])

    def save(self) -> None:
        """Writes the checkpoint; the previous one stays intact until the new one is complete.

        Raises:
            DivergenceError: see `check`; nothing is written.
        """
        self.check()
        save_checkpoint(self.run.checkpoint_path, self.state())

    def check(self) -> None:
        """Checks that losses and metrics are finite.

        Raises:
            DivergenceError: if one is not; names the last good checkpoint.
        """
        try:
            self.agent.divergence.check()
        except DivergenceError as error:
            raise self._diverged(str(error)) from error

    def act(self) -> TensorDictBase:
        """Returns the current observation with the policy's actions.

        Raises:
            DivergenceError: if the policy's outputs are nan or infinite.
        """
        assert self.observation is not None
        try:
            with torch.no_grad():
                return self.agent.policy(self.observation)
        except RuntimeError as error:
            self.check()  # an update may have seen it first, and its error says more
            if "probability tensor" not in str(error):
                raise
            maps = [key for key in self.agent.policy.in_keys if _is_bad(self.observation[key])]
            cause = f"{maps[0]!r} is not finite: lower its scale" if maps else "weights too large"
            raise self._diverged(
                f"the policy gives actions no probabilities after {self.agent.updates} updates "
                f"({cause})"
            ) from error

    def _diverged(self, what: str) -> DivergenceError:
        path = self.run.checkpoint_path
        good = f"the last good checkpoint is {path}" if path.exists() else "none was saved yet"
        return DivergenceError(f"{what}; {good}")

    def load(self) -> None:
        """Continues from the checkpoint, and deletes what was logged after it.

        Raises:
            CheckpointError: if it can't be read, or belongs to another run.
        """
        path = self.run.checkpoint_path
        state = load_checkpoint(path)
        check_origin(state["origin"], self.origin, path)
        self.restore(state)
        self.run.forget_after(self.frames)


def train(
    training: Training,
    config: Mapping[str, Any],
    stop: StopRequest,
    evaluate: Callable[[int], bool],
) -> Stopwatch:
    """Trains until `total_frames` or until a stop is requested, and saves the last state.

    The updates that the previous frames allow are taken between choosing an action and waiting for
    its step. Environments that have processes and cores of their own step meanwhile, which
    TorchRL's sequential `Trainer` does not support. The order of operations, and so the result, is
    the same where they do not.

    Args:
        training: a new or a restored run.
        config: the resolved config.
        stop: checked between two steps.
        evaluate: takes the number of frames; returns whether it was interrupted and has to be run
            again when the run is resumed.

    Returns:
        The wall time by activity.
    """
    t = training
    clock = Stopwatch()
    should_log = Every(config["log_every_frames"], t.frames)
    should_evaluate = Every(config["evaluation"]["every_frames"], t.frames)
    should_save = Every(config["checkpoint_every_frames"], t.frames)
    total = config["total_frames"]
    is_on_gpu = t.agent.device.type == "cuda"
    steps_meanwhile = is_on_gpu or has_spare_cores(t.env, torch.get_num_threads())
    if t.observation is None:
        t.observation = t.env.reset()
    if t.evaluation_pending:
        with clock("evaluation"):
            t.evaluation_pending = evaluate(t.frames)
    with tqdm(total=total, initial=t.frames, unit="frame", unit_scale=True, mininterval=0.5) as bar:
        while t.frames < total and not stop:
            with clock("policy"):
                acted = t.act()
            if steps_meanwhile:
                begin_step(t.env, acted)
            learn(t, clock)
            with clock("environment"):
                stepped, t.observation = t.env.step_and_maybe_reset(acted)
            with clock("memory"):
                t.agent.remember(stepped)
            t.frames += stepped.numel()
            t.recent.add(stepped)
            if t.frames >= total:
                learn(t, clock)  # there is no next step to overlap with
            bar.update(t.frames - bar.n)
            if should_log(t.frames):
                t.check()
                row = metrics_row(t, bar.format_dict["rate"], clock)
                t.run.log_metrics(t.frames, row)
                bar.set_postfix_str(progress_text(row))
            if should_evaluate(t.frames):
                with clock("evaluation"):
                    t.evaluation_pending = evaluate(t.frames)
            if should_save(t.frames):
                with clock("checkpoint"):
                    t.save()
    with clock("checkpoint"):
        t.save()
    return clock


def learn(training: Training, clock: Stopwatch) -> None:
    """Takes the updates that are due after the frames so far."""
    agent = training.agent
    for _ in range(agent.updates_due(training.frames)):
        with clock("memory"):
            batch = agent.sample()
        with clock("update"):
            training.metrics.add(agent.update(batch))


def _is_bad(values: Tensor) -> bool:
    return values.is_floating_point() and not bool(values.isfinite().all())


def metrics_row(training: Training, rate: float | None, clock: Stopwatch) -> dict[str, float]:
    """Returns one row of metrics.csv and starts the next; missing values are nan.

    docs/metrics.md explains the columns.
    """
    row = training.recent.summary()
    row["updates"] = training.agent.updates
    row["frames_per_second"] = rate or math.nan
    row["share_outside_updates"] = 1 - clock.share("update")
    means = training.metrics.take()
    return row | {name: means.get(name, math.nan) for name in training.agent.metric_names()}


def progress_text(row: Mapping[str, float]) -> str:
    """Returns the end of the progress line; nan values are left out."""
    losses = [name for name in row if name.endswith("_loss")]
    shown = {"success": f"{row['success']:.0%}"}
    shown |= {name: f"{row[name]:.3g}" for name in ("alpha", "entropy", *losses) if name in row}
    return ", ".join(
        f"{name.replace('_', ' ')} {text}" for name, text in shown.items() if "nan" not in text
    )
