"""Agents to evaluate, with what they see: those of runs, and policies of the user's own."""

from dataclasses import dataclass

import torch
from torchrl.data import Composite

from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.config import UsageError
from flowrep.config.run_names import OF_THE_MACHINE
from flowrep.config.training import validated_run
from flowrep.config.violations import shown
from flowrep.envs import street_envs
from flowrep.exchange.cards import check_card
from flowrep.exchange.policies import Task, load_policy
from flowrep.experiment.arena import Agent
from flowrep.experiment.comparison import Comparison, Row, with_origin
from flowrep.experiment.origin import check_origin, differences, origin_of
from flowrep.experiment.run_folder import Rows, RunFolder
from flowrep.from_config import Config, choose_device, env_from_config, policy_from_config

OF_THE_EVALUATION = (*OF_THE_MACHINE, "num_envs")  # not of the run


@dataclass(frozen=True)
class Subject:
    """An agent to evaluate: a run's agent, or the user's own policy.

    Args:
        run: the run's folder, or the folder for the table of the user's own policy.
        config: the run's config with the requested scene and machine settings.
        agent: its policy and observations.
        frames: the frames that it was trained for.
        table: the rows of the run's table before this evaluation.
    """

    run: RunFolder
    config: Config
    agent: Agent
    frames: int
    table: Rows

    def rows(self, comparison: Comparison, number: int) -> list[Row]:
        """Returns the rows of its episodes so far; `number` is its number in the comparison."""
        return with_origin(comparison.rows(number), self.config, self.frames, "evaluate")


def load_subject(asked: Config, run: RunFolder) -> Subject:
    """Returns a run's agent in the requested scene, by default its own.

    Raises:
        UsageError, TableError: its config or its table is damaged, or the scene has the name of its
            own and is another; all are checked before any episode is run.
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
    """
    own = validated_run(run.read_config(), f"{run.path}/config.yaml")
    table = run.read_episodes()
    path = run.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own), path)
    here = {key: asked[key] for key in OF_THE_EVALUATION}
    scene = asked.get("scene")
    if scene is not None:  # the agent keeps its camera in other scenes
        here["scene"] = scene | {"camera": own["scene"]["camera"]}
    config = own | here
    check_scene(run, own["scene"], config["scene"])
    env = env_from_config(config, num_envs=1, num_workers=0)
    policy = policy_from_config(config, env, trust=config["trust"])
    env.close()
    try:
        policy.load_state_dict(state["policy"])
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"the agent of {run.path} can't look at scene '{config['scene']['name']}', which has "
            f"other classes than its own ({reason})"
        ) from error
    device = choose_device(config["device"])
    agent = Agent.from_config(policy, config, device)
    return Subject(run, config, agent, state["frames"], table)


def check_scene(run: RunFolder, own: Config, asked: Config) -> None:
    """Checks that episodes in a scene can't be taken for some in the run's own scene.

    Raises:
        UsageError: it has the name of the run's own scene and differs from it.
    """
    if asked["name"] != own["name"]:
        return
    for place, there, here in differences(own, asked, "scene"):
        raise UsageError(
            f"{run.path} was trained with {place}={shown(there)}, and rows with {shown(here)} "
            f"would be taken for the same scene, '{own['name']}': give this one another name with "
            "scene.name=, or leave scene= out"
        )


def load_own(asked: Config, name: str, folder: RunFolder) -> Subject:
    """Returns the user's own policy with its observations.

    Raises:
        PolicyError, TableError: as `check_card`, `load_policy` and `RunFolder.read_episodes`.
    """
    table = folder.read_episodes()
    config = {key: asked[key] for key in (*OF_THE_EVALUATION, "scene", "representations")}
    config |= {"flow": asked.get("flow") or {"source": "exact"}, "noise": asked.get("noise")}
    config |= {"renderer": "auto"}
    config |= {"speed": "normal", "seed": ""}  # of its training, which is unknown
    env = env_from_config(config, num_envs=1, num_workers=0)
    device = choose_device(config["device"])
    task = Task(
        scene=config["scene"]["name"],
        representations=config["representations"],
        observation_spec=Composite(
            {name: env.observation_spec[name][0] for name in config["representations"]}
        ),
        action_spec=env.action_spec[0],
        intrinsics=torch.from_numpy(street_envs(env)[0].K),
        device=device,
    )
    env.close()
    check_card(name, task)
    agent = Agent.from_config(load_policy(name, task), config, device)
    return Subject(folder, config, agent, frames=0, table=table)
