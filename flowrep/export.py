"""Exports a trained agent: `python -m flowrep.export run=outputs/...`."""

from pathlib import Path
from typing import Any

from flowrep.extras import require

require("an export", "train", "hydra", "pydantic", module=__name__)

from torchrl.envs import EnvBase

from flowrep import __version__
from flowrep.agent import load_checkpoint
from flowrep.config.cli import run_command
from flowrep.config.schema import ExportConfig, TrainConfig, validated_run
from flowrep.envs import street_envs
from flowrep.exchange.programs import acting_program, write_agent
from flowrep.experiment import build
from flowrep.experiment.run import RunFolder, check_origin, origin_of
from flowrep.scenes import load_scene

ACTIONS = ("no_op", "turn_left", "turn_right")  # by their indices in flowrep.scenes.scene


def run(config: ExportConfig) -> None:
    """Writes the agent of a run as files that can be used without flowrep."""
    folder = export(RunFolder.existing(config.run), config.output)
    print(f"the agent is in {folder}; load_agent.py there shows how to run it")


def export(run: RunFolder, output: str | None = None) -> Path:
    """Writes a run's agent, which computes in float32 on any machine; returns the folder.

    Args:
        run: the run's folder.
        output: the folder to write; `export` in the run's own if None.

    Raises:
        UsageError: its config is damaged.
        CheckpointError: there is no checkpoint, it is damaged, or belongs to another run.
        ExportError: its algorithm's policy can't be exported.
    """
    own = validated_run(run.read_config(), f"{run.path}/config.yaml")
    state = load_checkpoint(run.checkpoint_path, ["origin", "frames", "policy"])
    check_origin(state["origin"], origin_of(own.plain()), run.checkpoint_path)
    algorithm = own.algorithm
    if "precision" in algorithm.options():
        algorithm = algorithm.model_copy(update={"precision": "fp32"})
    config = own.model_copy(update={"algorithm": algorithm, "device": "cpu"})
    env = build.env(config, num_envs=1, num_workers=0)
    policy = build.policy(config, env)
    policy.load_state_dict(state["policy"])
    program = acting_program(policy, env.observation_spec)
    card = agent_card(config, env, state["frames"])
    env.close()
    folder = Path(output or run.path / "export")
    write_agent(folder, program, card)
    return folder


def agent_card(config: TrainConfig, env: EnvBase, frames: int) -> dict[str, Any]:
    """Returns the description that others need to give the agent its observations."""
    spec, (street,) = env.observation_spec, street_envs(env)
    scene = load_scene(config.scene)
    return {
        "flowrep": __version__,
        "maps": [
            {
                "name": name,
                "shape": list(spec[name].shape[1:]),
                "dtype": str(spec[name].dtype).removeprefix("torch."),
                "options": options or {},
            }
            for name, options in config.representations.items()
        ],
        "actions": list(ACTIONS),
        "flow": config.flow.plain(),
        "noise": config.noise.plain(),
        "intrinsics": street.K.tolist(),
        "num_classes": street.num_classes,
        "frame_rate_hz": street.frame_rate_hz,
        "scene": scene.name,
        "algorithm": config.algorithm.plain(),
        "frames": frames,
    }


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that names the remedy."""
    run_command("export", run, ExportConfig)


if __name__ == "__main__":
    main()
