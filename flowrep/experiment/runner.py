"""The loop of a run: training from its start or its checkpoint, evaluation and film."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flowrep.agent import (
    CheckpointError,
    DivergenceError,
    keep_freed_memory,
    load_checkpoint,
    save_checkpoint,
    torch_threads,
)
from flowrep.agent.precision import has_bf16
from flowrep.envs import WorkerError, begin_step, get_states, has_spare_cores, set_states
from flowrep.experiment import build
from flowrep.experiment.evaluation import EVALUATION_ENVS, FIRST_SEEDS, Driver, PairedEvaluation
from flowrep.experiment.outcomes import OUTCOMES, print_results
from flowrep.experiment.provenance import check_origin, machine_of, origin_of
from flowrep.experiment.run import RunFolder
from flowrep.experiment.schema import TrainConfig
from flowrep.progress import StopRequest, Stopwatch, progress_bar


@dataclass
class Every:
    """True once each time a step counter passes a multiple of `interval`; never if that is 0."""

    interval: int
    last: int = 0

    def __call__(self, step: int) -> bool:
        """Returns whether `step` reached or jumped over a multiple since the last call."""
        if not self.interval or step // self.interval <= self.last // self.interval:
            return False
        self.last = step
        return True


class Runner:
    """Holds the env, the agent, the folder and the clock of a run; `train` is its loop.

    `save` and `load` write and read its checkpoint: all that the rest of the run depends on.
    """

    def __init__(
        self,
        config: TrainConfig,  # as `build.resolved` returned it
        folder: RunFolder,
        on_log: Callable[[dict[str, float]], Any] | None = None,  # gets each row of metrics.csv
    ) -> None:
        self.folder, self.clock, self.on_log = folder, Stopwatch(), on_log
        logging.getLogger("torchrl").setLevel(logging.WARNING)  # it logs every storage it creates
        keep_freed_memory()
        self.config, (self.env, self.agent) = config, build.training(config)
        precision = getattr(config.algorithm, "precision", "fp32")  # not an option of every one
        self.machine = machine_of(precision) | {"threads": config.threads}
        self.frames = 0  # of all envs, so far
        self.observation: TensorDictBase | None = None  # for the next action
        self.evaluation_pending = False  # whether a stop interrupted the last one
        self.metrics, self.recent = Means(), RecentEpisodes()

    def train(self, stop: StopRequest) -> None:
        """Trains until `total_frames` or until a stop is requested, and saves the last state."""
        total = self.config.total_frames
        self.folder.log_machine(self.machine)
        log = Every(self.config.log_every_frames, self.frames)
        evaluate = Every(self.config.evaluation.every_frames, self.frames)
        save = Every(self.config.checkpoint_every_frames, self.frames)
        # Updates run between choosing an action and waiting for its step, during which envs in
        # worker processes step on spare cores; TorchRL's sequential `Trainer` can't do that. The
        # order of operations, and so the result, is the same without workers.
        is_on_gpu = self.agent.device.type == "cuda"
        steps_meanwhile = is_on_gpu or has_spare_cores(self.env, self.config.threads)
        if self.observation is None:
            self.observation = self.env.reset()
        if self.evaluation_pending:
            self.evaluation_pending = not self.evaluate("training", stop)
        # No `desc`: the metrics at the line's end need the columns.
        with progress_bar(
            what="training", desc=None, total=total, initial=self.frames, unit="frame",
            unit_scale=True, miniters=0, mininterval=0.5, dynamic_ncols=True,
        ) as bar:  # fmt: skip
            while self.frames < total and not stop:
                with self.clock("policy"):
                    acted = self.act()
                if steps_meanwhile:
                    begin_step(self.env, acted)
                self.learn(bar)
                with self.clock("environment"):
                    stepped, self.observation = self.env.step_and_maybe_reset(acted)
                with self.clock("memory"):
                    self.agent.remember(stepped)
                self.frames += stepped.numel()
                self.recent.add(stepped)
                if self.frames >= total:
                    self.learn(bar)  # no next step is left to overlap with
                bar.update(self.frames - bar.n)
                if log(self.frames):
                    row = self.log(bar.format_dict["rate"])
                    bar.set_postfix_str(progress_text(row))
                if evaluate(self.frames):
                    self.evaluation_pending = not self.evaluate("training", stop)
                if save(self.frames) and self.frames < total:  # the last state is saved below
                    self.save()
        self.save()

    def act(self) -> TensorDictBase:
        """Returns the current observation with the policy's actions."""
        assert self.observation is not None
        try:
            with torch.no_grad():
                return self.agent.act(self.observation)
        except RuntimeError as error:
            self.check()  # the loss may have diverged first, and that error says more
            if self.agent.policy.get_dist(self.observation).probs.isfinite().all():
                raise
            keys = self.agent.policy.in_keys
            maps = [key for key in keys if not self.observation[key].isfinite().all()]
            cause = f"{maps[0]!r} is not finite: lower its scale" if maps else "weights too large"
            raise self._diverged(
                f"the policy gives actions no probabilities after {self.agent.updates} updates "
                f"({cause})"
            ) from error

    def learn(self, bar: Any) -> None:
        """Runs the updates that are due after the frames so far."""
        for _ in range(self.agent.updates_due(self.frames)):
            bar.update(0)  # redraws its clock: an update of the paper's size takes a second
            with self.clock("memory"):
                batch = self.agent.sample()
            with self.clock("update"), torch_threads(self.config.threads):
                self.metrics.add(self.agent.update(batch))

    def log(self, rate: float | None) -> dict[str, float]:
        """Adds a row to metrics.csv, see docs/metrics.md, and returns it; missing is nan."""
        self.check()
        means = self.metrics.take()
        row = self.recent.summary()
        # tqdm knows no rate before its second update.
        row |= {"updates": self.agent.updates, "frames_per_second": rate or math.nan}
        row["share_outside_updates"] = 1 - self.clock.share("update")
        row |= {name: means.get(name, math.nan) for name in self.agent.metric_names()}
        self.folder.log_metrics(self.frames, row)
        if self.on_log is not None:
            self.on_log({"frames": self.frames} | row)
        return row

    def evaluate(self, kind: str, stop: StopRequest) -> bool:
        """Adds episodes to evaluation.csv; returns whether all were run before a stop.

        `kind` is "training", greedy episodes at the training's speed, or "final", episodes at each
        speed and frame rate, also of the baselines.
        """
        config, asked, fps = self.config, self.config.evaluation, self.env.base_env.frame_rate_hz
        if kind == "final":
            episodes = asked.speeds, asked.fps, asked.final_episodes, FIRST_SEEDS[kind]
            evaluation = PairedEvaluation(*episodes, asked.policies, asked.baselines)
        else:
            evaluation = PairedEvaluation([config.speed], [fps], asked.episodes, FIRST_SEEDS[kind])
        driver = self.driver()
        # The training's generator stays where it is, so that evaluating more often changes no run.
        with self.clock("evaluation"), torch.random.fork_rng(devices=[]):
            num_envs = max(EVALUATION_ENVS, config.num_envs)
            evaluation.run(driver.make_env, driver.policy, num_envs, stop=stop)
        if evaluation.done < evaluation.total:
            return False
        records = evaluation.records(**driver.origin(kind))
        self.folder.log_episodes(records)
        self.folder.log_machine(self.machine)
        if kind == "final":
            print_results([record.row() for record in records])
        return True

    def driver(self) -> Driver:
        """Returns the agent as it is evaluated."""
        policy = build.evaluated(self.config, self.env, self.agent.policy)
        return Driver(policy, self.config, self.frames)

    def film(self) -> None:
        """Films an episode if none is filmed."""
        # Drawing takes seconds to import.
        from flowrep.experiment.film import record_episode

        self.close()  # its worker processes take memory, and so does filming
        path = self.folder.video_path(f"episode_{self.config.speed}")
        if self.config.evaluation.video and not path.is_file():
            record_episode(self.driver(), path, episode_seed=FIRST_SEEDS["final"])
            print(f"video: {path}")

    def close(self) -> None:
        """Ends the envs' worker processes, and flushes TensorBoard."""
        if not self.env.is_closed:
            self.env.close()
        with suppress(OSError):  # only TensorBoard lacks numbers then; the tables have them
            self.folder.flush()

    def check(self) -> None:
        """Checks that losses and metrics are finite; the error names the last good checkpoint."""
        try:
            self.agent.divergence.check()
        except DivergenceError as error:
            raise self._diverged(str(error)) from error

    def _diverged(self, what: str) -> DivergenceError:
        path = self.folder.checkpoint_path
        good = f"the last good checkpoint is {path}" if path.exists() else "none was saved yet"
        return DivergenceError(f"{what}; {good}")

    def save(self) -> None:
        """Writes the checkpoint; the previous one stays intact until the new one is complete."""
        self.check()
        with self.clock("checkpoint"):
            save_checkpoint(self.folder.checkpoint_path, self.state())
        self.folder.log_machine(self.machine)

    def load(self) -> None:
        """Continues from the checkpoint and drops the rows logged after it."""
        path, config = self.folder.checkpoint_path, self.config
        if not path.exists():  # killed before the first one, or the file was removed
            # A step is of `num_envs` frames: the first one that ends at `due` or later is saved.
            due = min(config.checkpoint_every_frames, config.total_frames)
            self.folder.start_again(first_save=due + config.num_envs - 1)
            return
        device = self.agent.device
        if getattr(config.algorithm, "precision", None) == "bf16" and not has_bf16(device):
            print(f"note: this run computes in bf16, which this machine's {device.type} emulates")
        state = load_checkpoint(path)
        try:
            check_origin(state["origin"], origin_of(config.plain()), path)
            self._restore(state)
        except WorkerError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            what = f"{path} does not hold the state of this run ({error!r})"
            raise CheckpointError(f"{what}: restore the file, or start a new run") from error
        self.folder.forget_after(self.frames)

    def _restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state`, after the env's reset."""
        env = self.env
        self.frames = int(state["frames"])
        self.evaluation_pending = state["evaluation_pending"]
        self.metrics.restore(state["metrics"])
        self.recent.restore(state["recent"])
        self.observation = TensorDict(state["observation"], env.batch_size, device=env.device)
        self.agent.load_state_dict(state["agent"])
        self.agent.memory.load_state_dict(state["memory"])
        set_states(env, state["env"])
        # Last, so that nothing above moves the generators from where they stood.
        torch.set_rng_state(state["torch_rng"])
        if len(state["cuda_rng"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda_rng"])

    def state(self) -> dict[str, Any]:
        """Returns all that the rest of the run depends on, as nested plain data and tensors."""
        assert self.observation is not None
        return {
            "origin": origin_of(self.config.plain()),
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


def progress_text(row: Mapping[str, float]) -> str:
    """Returns the end of the progress line, short enough for 120 columns; nan is left out."""
    losses = [name for name in row if name.endswith("_loss")][:1]
    shown = {"success": f"{row['success']:.0%}"}
    shown |= {name: f"{row[name]:.3g}" for name in ("alpha", "entropy", *losses) if name in row}
    return ", ".join(
        f"{name.replace('_', ' ')} {text}" for name, text in shown.items() if "nan" not in text
    )


RECENT_EPISODES = 100


class RecentEpisodes:
    """Outcomes, returns and lengths of the latest finished episodes of all environments."""

    def __init__(self) -> None:
        self._running = torch.zeros(2, 1)  # [2, num_envs] from the first step: return, length
        self._ended: deque[tuple[int, float, int]] = deque(maxlen=RECENT_EPISODES)

    def add(self, stepped: TensorDictBase) -> None:
        """Adds a step of every environment, `[num_envs]`, as the env returned it."""
        after = stepped["next"]
        rewards = after["reward"].flatten().double()
        step = torch.stack([rewards, torch.ones_like(rewards)])
        # Not in place: restored sums are on the CPU, the env may be on a GPU.
        self._running = self._running.to(step.device) + step
        done = after["done"].flatten()
        outcomes = after["outcome"].flatten()[done].tolist()
        if outcomes:
            returns, lengths = self._running[:, done].tolist()
            self._ended.extend(zip(outcomes, returns, map(int, lengths)))
            self._running[:, done] = 0.0

    def summary(self) -> dict[str, float]:
        """Returns the share of each outcome, mean return and mean length; nan without episodes."""
        if not self._ended:
            return dict.fromkeys([*OUTCOMES, "return", "length"], math.nan)
        outcomes, returns, lengths = zip(*self._ended)
        ends = enumerate(OUTCOMES, start=1)  # 0 is the code of an episode that goes on
        shares = {name: outcomes.count(code) / len(outcomes) for code, name in ends}
        return shares | {"return": fmean(returns), "length": fmean(lengths)}

    def state(self) -> dict[str, Any]:
        """Returns the state that `restore` takes."""
        return {"running": self._running, "ended": [list(episode) for episode in self._ended]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state`."""
        self._running = state["running"]
        self._ended = deque(map(tuple, state["ended"]), maxlen=RECENT_EPISODES)


class Means:
    """Means of the updates' metrics since the last row; adding one doesn't wait for a GPU."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Adds the metrics of one update."""
        for name, value in metrics.items():
            # Not in place: restored sums are on the CPU, and a CUDA graph reuses its tensors.
            self._sums[name] = self._sums.get(name, 0) + value.detach()
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
        self._sums, self._count = dict(state["sums"]), state["count"]
