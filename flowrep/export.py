"""Exports a trained agent: `python -m flowrep.export run=outputs/...`."""

from pathlib import Path
from typing import Any

from flowrep.console import prepare
from flowrep.extras import require

if __name__ == "__main__":
    prepare()
require("an export", "train", "hydra", "pydantic", module=__name__)

import hydra
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from flowrep import __version__
from flowrep.agent import CheckpointError, load_checkpoint
from flowrep.config import UsageError, validated
from flowrep.config.command_line import exit_with, own_keys, plain_config, run_command
from flowrep.config.exporting import ExportConfig
from flowrep.config.training import validated_run
from flowrep.config_tree import CONF_DIR
from flowrep.envs import street_envs
from flowrep.exchange.programs import acting_program, write_agent
from flowrep.experiment.run import RunFolder, check_origin, origin_of
from flowrep.from_config import Config, env_from_config, policy_from_config
from flowrep.scenes import load_scene

ACTIONS = ("no_op", "turn_left", "turn_right")  # by their indices in flowrep.scenes.scene


@hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name="export")
def run(config: DictConfig) -> None:
    """Writes the agent of a run as files that can be used without flowrep."""
    try:
        asked = plain_config(config)
        validated(ExportConfig, asked, own_keys())
        folder = export(asked, RunFolder.existing(asked["run"]))
    except (UsageError, CheckpointError, ValueError, ImportError, OSError) as error:
        exit_with(error)
    print(f"the agent is in {folder}; load_agent.py there shows how to run it")


def export(asked: Config, run: RunFolder) -> Path:
    """Writes a run's agent, which computes in float32 on any machine; returns the folder.

    Raises:
        UsageError: its config is damaged.
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
        ExportError: its algorithm's policy can't be exported.
    """
    own = validated_run(run.read_config(), f"{run.path}/config.yaml")
    state = load_checkpoint(run.checkpoint_path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own), run.checkpoint_path)
    portable = own["algorithm"] | ({"precision": "fp32"} if "precision" in own["algorithm"] else {})
    config = own | {"algorithm": portable, "device": "cpu"}
    env = env_from_config(config, num_envs=1, num_workers=0)
    policy = policy_from_config(config, env, trust=asked["trust"])
    policy.load_state_dict(state["policy"])
    program = acting_program(policy, env.observation_spec)
    card = agent_card(config, env, state["frames"])
    env.close()
    folder = Path(asked["output"] or run.path / "export")
    write_agent(folder, program, card)
    return folder


def agent_card(config: Config, env: EnvBase, frames: int) -> dict[str, Any]:
    """Returns the description that others need to give the agent its observations."""
    spec, (street,) = env.observation_spec, street_envs(env)
    scene = load_scene(config["scene"])
    return {
        "flowrep": __version__,
        "maps": [
            {
                "name": name,
                "shape": list(spec[name].shape[1:]),
                "dtype": str(spec[name].dtype).removeprefix("torch."),
                "options": options or {},
            }
            for name, options in config["representations"].items()
        ],
        "actions": list(ACTIONS),
        "flow": config["flow"],
        "noise": config["noise"],
        "intrinsics": street.K.tolist(),
        "num_classes": street.num_classes,
        "frame_rate_hz": street.frame_rate_hz,
        "scene": scene.name,
        "algorithm": config["algorithm"],
        "frames": frames,
    }


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    run_command("export", run, ExportConfig)


if __name__ == "__main__":
    main()
