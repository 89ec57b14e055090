"""The training loop: act, store, learn, and now and then log, evaluate and save."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from flowrep.agent import DiscreteSAC, load_checkpoint, save_checkpoint
from flowrep.envs import get_states, set_states
from flowrep.experiment.cadence import Every, UpdatesDue
from flowrep.experiment.evaluation import OUTCOMES
from flowrep.experiment.interruption import StopRequest
from flowrep.experiment.run_folder import RunFolder
from flowrep.experiment.stopwatch import Stopwatch

RECENT_EPISODES = 100
LEARNING_METRICS = (
    "q_loss", "actor_loss", "alpha_loss", "alpha", "entropy", "td_error", "learning_rate"
)  # fmt: skip


@dataclass
class Training:
    """Everything that a run continues from; `state` and `restore` are its checkpoint.

    Args:
        env: batched TorchRL env.
        agent: the algorithm, with its replay memory.
        run: the folder that the run writes to.
    """

    env: EnvBase
    agent: DiscreteSAC
    run: RunFolder
    frames: int = 0
    updates: int = 0
    carried: TensorDictBase | None = None
    recent: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT_EPISODES))

    def state(self) -> dict[str, Any]:
        """Returns all that the rest of the run depends on, as nested plain data and tensors."""
        assert self.carried is not None
        return {
            "frames": self.frames,
            "updates": self.updates,
            "recent": list(self.recent),
            "carried": self.carried.to_dict(),
            "agent": self.agent.state_dict(),
            "replay": self.agent.replay.state_dict(),
            "env": get_states(self.env),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continues where `state` was taken."""
        self.env.reset()
        self.frames, self.updates = state["frames"], state["updates"]
        self.recent.extend(state["recent"])
        self.carried = TensorDict(state["carried"], self.env.batch_size, device=self.env.device)
        self.agent.load_state_dict(state["agent"])
        self.agent.replay.load_state_dict(state["replay"])
        set_states(self.env, state["env"])
        torch.set_rng_state(state["torch_rng"])
        if len(state["cuda_rng"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda_rng"])

    def save(self) -> None:
        """Writes the checkpoint; the last one stays whole until the new one is."""
        save_checkpoint(self.run.checkpoint_path, self.state())

    def load(self) -> None:
        """Continues from the checkpoint, and forgets what was logged after it."""
        self.restore(load_checkpoint(self.run.checkpoint_path))
        self.run.forget_after(self.frames)


def train(
    training: Training,
    config: Mapping[str, Any],
    stop: StopRequest,
    evaluate: Callable[[int], None],
) -> Stopwatch:
    """Trains until `total_frames` or until a stop is asked for; the last state is saved.

    Args:
        training: a new or a restored run.
        config: the resolved config.
        stop: asked between two steps.
        evaluate: gets the number of frames.

    Returns:
        Where the wall time went.
    """
    t = training
    clock = Stopwatch()
    should_log = Every(config["log_every_frames"], t.frames)
    should_evaluate = Every(config["evaluation"]["every_frames"], t.frames)
    should_save = Every(config["checkpoint_every_frames"], t.frames)
    replay = t.agent.replay
    updates_due = UpdatesDue(replay.frames_per_update, replay.learning_starts, done=t.updates)
    total = config["total_frames"]
    losses: TensorDictBase | None = None
    if t.carried is None:
        t.carried = t.env.reset()
    with tqdm(total=total, initial=t.frames, unit="frame", unit_scale=True, mininterval=0.5) as bar:
        while t.frames < total and not stop:
            with clock("policy"), torch.no_grad():
                acted = t.agent.policy(t.carried)
            with clock("environment"):
                stepped, t.carried = t.env.step_and_maybe_reset(acted)
            with clock("replay"):
                replay.extend(stepped)
            t.frames += stepped.numel()
            t.recent.extend(finished_outcomes(stepped))
            for _ in range(updates_due(t.frames)):
                with clock("replay"):
                    batch = replay.sample()
                with clock("update"):
                    losses = t.agent.update(batch)
                t.updates += 1
            bar.update(t.frames - bar.n)
            if should_log(t.frames):
                row = metrics_row(t, losses, bar.format_dict["rate"], clock)
                t.run.log_metrics(t.frames, row)
                bar.set_postfix_str(progress_text(row))
            if should_evaluate(t.frames):
                with clock("evaluation"):
                    evaluate(t.frames)
            if should_save(t.frames):
                with clock("checkpoint"):
                    t.save()
    with clock("checkpoint"):
        t.save()
    return clock


def finished_outcomes(stepped: TensorDictBase) -> list[int]:
    """Returns the outcome codes of the episodes that this step ended."""
    after = stepped["next"]
    return after["outcome"][after["done"]].tolist()


def metrics_row(
    training: Training, losses: TensorDictBase | None, rate: float | None, clock: Stopwatch
) -> dict[str, float]:
    """Returns one row of metrics.csv; nan stands for what there is none of yet.

    `success` and its siblings are shares of the last `RECENT_EPISODES` training episodes, which
    sample their actions; the losses are those of the last update.
    """
    recent = training.recent
    row = {
        name: recent.count(code) / len(recent) if recent else math.nan
        for code, name in enumerate(OUTCOMES)
        if code
    }
    row["updates"] = training.updates
    row["frames_per_second"] = rate or math.nan
    row["share_outside_updates"] = 1 - clock.share("update")
    values = losses.to_dict() if losses is not None else {}
    return row | {name: float(values.get(name, math.nan)) for name in LEARNING_METRICS}


def progress_text(row: Mapping[str, float]) -> str:
    """Returns what stands at the end of the progress line; nothing stands for nan."""
    shown = {
        "success": f"{row['success']:.0%}",
        "α": f"{row['alpha']:.3f}",
        "entropy": f"{row['entropy']:.2f}",
        "Q loss": f"{row['q_loss']:.3g}",
        "policy loss": f"{row['actor_loss']:.3g}",
    }
    return ", ".join(f"{name} {text}" for name, text in shown.items() if "nan" not in text)
