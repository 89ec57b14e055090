"""Trains an agent: `python -m flowrep.train representations=[ego,obj] preset=laptop`."""

import logging
import sys
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial

from flowrep.console import prepare
from flowrep.extras import require

if __name__ == "__main__":
    prepare()
require("training", "train", "hydra", "pydantic", "matplotlib", "imageio", module=__name__)

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from flowrep.agent import (
    CheckpointError,
    DivergenceError,
    FasterThreads,
    keep_freed_memory,
)
from flowrep.config import UsageError, validated
from flowrep.config.command_line import (
    exit_with,
    line_for,
    own_keys,
    plain_config,
    run_command,
    typed_value,
)
from flowrep.config.quoting import override
from flowrep.config.training import TrainConfig
from flowrep.config_tree import CONF_DIR
from flowrep.envs import WorkerError
from flowrep.envs.workers import available_cores
from flowrep.experiment.arena import Agent
from flowrep.experiment.arena_team import AnyArena
from flowrep.experiment.comparison import Comparison, print_table, with_origin
from flowrep.experiment.failures import print_failures, write_failures
from flowrep.experiment.run import RunFolder, RunFolderError, origin_of
from flowrep.experiment.runner import Training, train
from flowrep.from_config import (
    Config,
    agent_from_config,
    arena_from_config,
    choose_device,
    env_from_config,
)
from flowrep.progress import StopRequest
from flowrep.resuming import how_to_resume, resumed_config
from flowrep.scenes import SceneError, load_scene
from flowrep.sweeps.plan import is_sweep
from flowrep.sweeps.sweep import run_sweep
from flowrep.tables import TableError
from flowrep.viz.curves import draw_learning_curve
from flowrep.viz.film import record_episode

FINAL_POLICIES = ("greedy", "sampled")  # the agent's, evaluated beside the baselines
EVALUATION_ENVS = 96  # side by side at least: more make a step of each cheaper
EVALUATION_SEED = 1_000_000  # of the first episode evaluated during training
FINAL_SEED = 1_500_000  # not the episodes evaluated during training


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="train")
def run(config: DictConfig) -> float:
    """Trains, evaluates and films one agent, or continues a run with `resume=`.

    Returns:
        The share of greedy episodes in the final evaluation that succeed, over all its speeds and
        frame rates. A sweeper such as Optuna maximises it.
    """
    try:
        plain = plain_config(config)
        validated(TrainConfig, plain, own_keys())
        is_new = plain["resume"] is None
        if is_new:
            load_scene(plain["scene"])
        job = HydraConfig.get()
        new = job.runtime.output_dir
        folder = RunFolder(new) if is_new else RunFolder.existing(plain["resume"])
        with folder.held("training"):
            if is_new:
                folder.check_is_new()
                folder.write_config(plain, job.overrides.task)
            else:
                plain = resumed_config(plain, folder, job.overrides.task)
            return carry_out(plain, folder)
    except (UsageError, SceneError, RunFolderError, TableError, OSError) as error:
        exit_with(error)


def carry_out(config: Config, folder: RunFolder) -> float:
    """Does what remains of a run (training, evaluation, video) and returns its success."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it logs every storage it creates
    try:
        training = make_training(config, folder)
        folder.log_to_wandb(config["wandb"], config)
    except (UsageError, CheckpointError, WorkerError, ValueError, ImportError, OSError) as error:
        exit_with(error)
    print(f"run folder: {folder.path}")
    where, how_to_go_on = str(folder.path), how_to_resume(config, folder)
    is_evaluated = training.frames >= config["total_frames"] and folder.is_evaluated(
        training.frames, final_episodes(config)
    )
    if is_evaluated:
        print(f"this run is complete; evaluate it with: {line_for('evaluate', run=where)}")
    with StopRequest() as stop:
        try:
            if not is_evaluated:
                with closing(make_arena(training, config)) as arena:
                    evaluate = partial(log_evaluation, training, config, arena, stop)
                    clock = train(training, config, stop, evaluate)
                    print(f"wall time: {clock.summary()}")
                    print(f"outside gradient updates: {1 - clock.share('update'):.0%}")
                    is_evaluated = not stop and final_evaluation(training, config, arena, stop)
            if is_evaluated:
                show(training, config)
        except (CheckpointError, DivergenceError) as error:
            exit_with(f"after {training.frames} frames: {error}")
        except WorkerError as error:
            exit_with(f"after {training.frames} frames: {error}", f"Continue with: {how_to_go_on}")
        except BrokenPipeError:
            raise  # from printing: the disk is not full
        except OSError as error:
            exit_with(
                f"after {training.frames} frames: {error}. Free some space or make the folder "
                f"writable, then continue with: {how_to_go_on}"
            )
    training.env.close()
    if stop:
        print(
            f"\nstopped after {training.frames} frames; the run is saved. Continue with\n"
            f"  {how_to_go_on}"
        )
        sys.exit(stop.exit_code)
    return final_success(folder, training.frames)


def final_success(folder: RunFolder, frames: int) -> float:
    """Returns the share of final greedy episodes of a run of `frames` frames that succeed."""
    outcomes = [
        row["outcome"]
        for row in folder.read_episodes()
        if (row["evaluation"], row["policy"], int(row["frames"])) == ("final", "greedy", frames)
    ]
    return outcomes.count("success") / len(outcomes)


def make_training(config: Config, folder: RunFolder) -> Training:
    """Returns the run at its checkpoint, or at its start if it was killed before the first one."""
    is_new = config["resume"] is None
    is_saved = folder.checkpoint_path.exists()
    if not is_new and not is_saved:
        folder.start_again(config)
    keep_freed_memory()
    threads = share_cores(config)
    torch.manual_seed(config["seed"])
    env = env_from_config(config, compiled=config["compiled"])
    env.set_seed(config["seed"] * config["num_envs"])
    # the class of a new run was named on the command line
    trusted = config["algorithm"]["_target_"] if is_new else config["trust"]
    agent = agent_from_config(config, env, trust=trusted)
    agent.threads = threads
    training = Training(env, agent, folder, origin_of(config))
    if not is_new and is_saved:
        training.load()
    return training


def share_cores(config: Config) -> AbstractContextManager[None]:
    """Returns the context of the updates, which may use as many threads as PyTorch would.

    Everything else is small and gets one thread, except estimated flow.
    """
    if choose_device(config["device"]).type != "cpu":
        return nullcontext()
    most = min(torch.get_num_threads(), available_cores())
    if config["flow"]["source"] == "exact":
        torch.set_num_threads(1)
    return FasterThreads(most)


def log_evaluation(
    training: Training, config: Config, arena: AnyArena, stop: StopRequest, frames: int
) -> bool:
    """Adds greedy episodes at the training speed to evaluation.csv; returns whether it stopped."""
    comparison = Comparison(
        speeds=[config["speed"]],
        fps=[config["scene"]["frame_rate_hz"]],
        episodes=config["evaluation"]["episodes"],
        seed=EVALUATION_SEED,
        policies=["greedy"],
    )
    with torch.random.fork_rng(devices=[]):
        comparison.run(arena, lambda: bool(stop))
    if comparison.is_complete:
        training.run.log_episodes(with_origin(comparison.rows(), config, frames, "training"))
    return not comparison.is_complete


def make_arena(training: Training, config: Config) -> AnyArena:
    """Returns what evaluates the agent in training, all its evaluations one after the other."""
    agent = Agent.from_config(training.agent.policy, config, training.agent.device)
    asked = config["evaluation"]["episodes"], final_episodes(config)
    num_envs = min(max(asked), max(EVALUATION_ENVS, config["num_envs"]))
    return arena_from_config(config, [agent], num_envs)


def final_episodes(config: Config) -> int:
    """Returns the number of episodes in the final evaluation."""
    evaluation = config["evaluation"]
    policies = len(FINAL_POLICIES) + len(evaluation["baselines"])
    conditions = len(evaluation["speeds"]) * len(evaluation["fps"])
    return conditions * policies * evaluation["final_episodes"]


def final_evaluation(
    training: Training, config: Config, arena: AnyArena, stop: StopRequest
) -> bool:
    """Compares the agent with baselines at each speed; returns False if it was stopped."""
    evaluation, run = config["evaluation"], training.run
    comparison = Comparison(
        speeds=evaluation["speeds"],
        fps=[float(rate) for rate in evaluation["fps"]],
        episodes=evaluation["final_episodes"],
        seed=FINAL_SEED,
        policies=FINAL_POLICIES,
        baselines=evaluation["baselines"],
    )
    comparison.run(arena, lambda: bool(stop))
    if not comparison.is_complete:
        return False
    rows = comparison.rows()
    run.log_episodes(with_origin(rows, config, training.frames, "final"))
    print_table(rows)
    print_failures(rows)
    return True


def show(training: Training, config: Config) -> None:
    """Writes the causes of failure and the learning curve, and films an episode unless it is there.

    To be called when the processes of the evaluation have ended, as it takes memory as well.
    """
    run = training.run
    write_failures(run.failures_path, run.read_episodes())
    draw_learning_curve(run)
    path = run.video_path(f"episode_{config['speed']}")
    if config["evaluation"]["video"] and not path.exists():
        make_env = partial(env_from_config, config)
        seen, policy = config["representations"], training.agent.policy
        record_episode(make_env, policy, seen, path, episode_seed=FINAL_SEED)
        print(f"video: {path}")


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    resumed = typed_value("resume")
    if resumed is not None:
        try:
            folder = RunFolder.existing(str(resumed))
        except RunFolderError as error:
            exit_with(error)
        place = max(i for i, a in enumerate(sys.argv) if a.startswith("resume="))
        sys.argv.insert(place + 1, override("hydra.run.dir", str(folder.path)))
    sweeps = is_sweep(sys.argv[1:])
    run_command("train", partial(run_sweep, "train") if sweeps else run, TrainConfig)


if __name__ == "__main__":
    main()
