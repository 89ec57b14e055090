"""Continues a run from its folder: the command that does, and the config that it then has."""

from collections.abc import Sequence
from typing import Any

from flowrep.config import UsageError
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.command_line import line_for
from flowrep.config.run_names import OF_THE_MACHINE
from flowrep.config.training import validated_run
from flowrep.experiment.run import RunFolder
from flowrep.from_config import Config


def how_to_resume(config: Config, folder: RunFolder) -> str:
    """Returns the command line that continues a run."""
    target = config["algorithm"]["_target_"]
    trust = {} if target in ALGORITHMS else {"trust": target}
    return line_for("train", resume=str(folder.path), **trust)


def resumed_config(
    plain: dict[str, Any], folder: RunFolder, given: Sequence[str]
) -> dict[str, Any]:
    """Returns the config of the run to resume, with the settings of the machine that are given.

    Args:
        plain: the composed config.
        folder: the run's folder.
        given: the overrides that were typed.

    Raises:
        UsageError: others than those of the machine were, or the run's config is damaged.
    """
    others = [
        o for o in given if not o.startswith(("resume=", *(f"{key}=" for key in OF_THE_MACHINE)))
    ]
    if others:
        raise UsageError(
            f"resume= continues a run with its own config, so '{others[0]}' would be ignored; "
            "leave it out (device=, num_workers= and trust= may be given)"
        )
    stored = validated_run(folder.read_config(), f"{folder.path}/config.yaml")
    # a class to trust is never taken from a file
    here = ["trust", "resume"]
    here += [key for key in OF_THE_MACHINE if any(o.startswith(f"{key}=") for o in given)]
    return stored | {key: plain[key] for key in here}
