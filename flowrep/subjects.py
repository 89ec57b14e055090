"""Agents to evaluate, with what they see: those of runs, and policies of the user's own."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torchrl.data import Composite

from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.config import UsageError
from flowrep.config.cli import OF_THE_MACHINE, folder_name
from flowrep.config.schema import EnvConfig, Noise, validated, validated_run
from flowrep.envs import street_envs
from flowrep.exchange.cards import check_card
from flowrep.exchange.policies import Task, load_policy
from flowrep.experiment import build
from flowrep.experiment.arena import Agent
from flowrep.experiment.comparison import Comparison, Row, with_origin
from flowrep.experiment.row_meanings import keep, known, maps_file, scene_file
from flowrep.experiment.run import Rows, RunFolder, check_origin, differences, origin_of

Config = Mapping[str, Any]
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
        trained_in: the name of the scene in the run's config, None for the user's own policy.
        policy: the name of the user's own policy, None for a run's agent.
    """

    run: RunFolder
    config: EnvConfig
    agent: Agent
    frames: int
    table: Rows
    trained_in: str | None = None
    policy: str | None = None

    def rows(self, comparison: Comparison, number: int) -> list[Row]:
        """Returns the rows of its episodes so far; `number` is its number in the comparison."""
        return with_origin(comparison.rows(number), self.config.plain(), self.frames, "evaluate")

    def save(self, rows: Sequence[Row]) -> None:
        """Saves rows, with the scene and the maps that they name unless the run's config has them.

        Raises:
            OSError: they can't be written.
        """
        scene = self.config.scene
        if rows and scene["name"] != self.trained_in:
            keep(scene_file(self.run, scene["name"]), scene)
        if rows and self.policy is not None:
            keep(maps_file(self.run, folder_name(self.policy)), maps_of(self.config.plain()))
        self.run.save_episodes(rows, self.table)


def load_subject(asked: Config, run: RunFolder) -> Subject:
    """Returns a run's agent in the requested scene, by default its own.

    Raises:
        UsageError, TableError: its config or its table is damaged, or the scene has the name of
            another one of the run's; all are checked before any episode is run.
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
    """
    own = validated_run(run.read_config(), f"{run.path}/config.yaml")
    table = run.read_episodes()
    path = run.checkpoint_path
    state = load_checkpoint(path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own.plain()), path)
    here = {key: asked[key] for key in OF_THE_EVALUATION}
    scene = asked.get("scene")
    if scene is not None:  # the agent keeps its camera in other scenes
        here["scene"] = scene | {"camera": own.scene["camera"]}
    config = own.model_copy(update=here)
    check_scene(run, config.scene, table, own=own.scene)
    env = build.env(config, num_envs=1, num_workers=0)
    policy = build.policy(config, env)
    env.close()
    try:
        policy.load_state_dict(state["policy"])
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"the agent of {run.path} can't look at scene '{config.scene['name']}', which has "
            f"other classes than its own ({reason})"
        ) from error
    agent = Agent.from_config(policy, config, build.device(config.device))
    return Subject(run, config, agent, state["frames"], table, own.scene["name"])


def check_scene(run: RunFolder, asked: Config, table: Rows, own: Config | None = None) -> None:
    """Checks that episodes in a scene can't be taken for some in another scene of its name.

    Args:
        run: the run's folder, or the folder for the table of the user's own policy.
        asked: the scene.
        table: the rows of the run's table.
        own: the scene in which the run was trained.

    Raises:
        UsageError: it differs from the scene that the run's config, or rows of its table, mean.
        RunFolderError: the file that holds that scene is damaged.
    """
    name = asked["name"]
    before = own if own is not None and own["name"] == name else None
    if before is None and any(row["scene"] == name for row in table):
        before = known(scene_file(run, name))
    for place, there, here in differences(before or asked, asked, "scene"):
        raise UsageError(
            f"in {run.path} scene '{name}' has {place}={there}, and rows with {here} "
            "would be taken for the same scene: give this one another name with scene.name="
            f"{', or leave scene= out' if before is own else ''}"
        )


def maps_of(config: Config) -> dict[str, Any]:
    """Returns the part of a config that decides what a policy sees, apart from the scene."""
    errors = {name: size for name, size in (config["noise"] or {}).items() if size}
    return {"representations": config["representations"], "flow": config["flow"], "noise": errors}


def check_maps(folder: RunFolder, config: Config, policy: str, table: Rows) -> None:
    """Checks that episodes of the user's own policy can't be taken for some with other maps.

    Raises:
        UsageError: what it sees differs from what it saw in the rows of the table.
        RunFolderError: the file that holds that is damaged.
    """
    if not any(row["policy"] == policy for row in table):
        return
    path = maps_file(folder, folder_name(policy))
    asked = json.loads(json.dumps(maps_of(config)))
    for place, there, here in differences(known(path) or asked, asked):
        raise UsageError(
            f"the rows of {policy} in {folder.path} have {place}={there}, and rows with "
            f"{here} would be taken for the same: give these another folder with output="
        )


def load_own(asked: Config, name: str, folder: RunFolder) -> Subject:
    """Returns the user's own policy with its observations.

    Raises:
        PolicyError, TableError: as `check_card`, `load_policy` and `RunFolder.read_episodes`.
        UsageError, RunFolderError: as `check_scene` and `check_maps`.
    """
    table = folder.read_episodes()
    plain = {key: asked[key] for key in (*OF_THE_EVALUATION, "scene", "representations")}
    plain |= {"flow": asked.get("flow") or {"source": "exact"}, "renderer": "auto"}
    plain["noise"] = asked.get("noise") or dict.fromkeys(Noise.key_names(), 0.0)
    plain |= {"speed": "normal", "seed": 0}  # of its training, which is unknown
    config = validated(EnvConfig, plain)
    check_scene(folder, config.scene, table)
    check_maps(folder, config.plain(), name, table)
    env = build.env(config, num_envs=1, num_workers=0)
    device = build.device(config.device)
    task = Task(
        scene=config.scene["name"],
        representations=config.representations,
        observation_spec=Composite(
            {name: env.observation_spec[name][0] for name in config.representations}
        ),
        action_spec=env.action_spec[0],
        intrinsics=torch.from_numpy(street_envs(env)[0].K),
        device=device,
    )
    env.close()
    check_card(name, task)
    agent = Agent.from_config(load_policy(name, task), config, device)
    return Subject(folder, config, agent, frames=0, table=table, policy=name)
