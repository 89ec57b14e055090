"""Exports a trained agent: `python -m flowrep.export run=outputs/...`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

from pathlib import Path

from flowrep.extras import require

require("an export", "train", "hydra", "pydantic", module=__name__)

from flowrep.config.cli import run_command
from flowrep.config.schema import ExportConfig


def run(config: ExportConfig) -> None:
    """Writes the agent of a run as files that can be used without flowrep."""
    from flowrep.experiment.run import RunFolder

    run = RunFolder.existing(config.run)

    from flowrep.experiment.agents import Agent
    from flowrep.experiment.exported import export

    folder = Path(config.output or run.path / "export")
    agent = Agent.load(
        run.path,
        representations=config.representations,
        trusted=config.trusted,
        precision="fp32",
        device="cpu",
    )
    export(agent, folder)
    print(f"the agent is in {folder}; load_agent.py there shows how to run it")


def main() -> None:
    """Entry point."""
    run_command("export", run, ExportConfig)


if __name__ == "__main__":
    main()
