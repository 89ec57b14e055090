"""The meaning of Hydra's flags, and which of them go together."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from hydra.core.plugins import Plugins
from hydra.plugins.completion_plugin import CompletionPlugin

from flowrep.config import UsageError


def only_shows(args: argparse.Namespace) -> bool:
    """Returns whether a command line only shows configs and starts no job."""
    return bool(args.help or args.hydra_help or args.cfg or args.info or args.shell_completion)


def check_flags(args: argparse.Namespace) -> None:
    """Refuses flags that contradict each other or would have no effect.

    Args:
        args: the command line, as Hydra's parser reads it.

    Raises:
        UsageError: names the flags, and what to leave out.
    """
    if args.experimental_rerun:
        raise UsageError(
            "--experimental-rerun reads a pickle, which can run any code: continue a run by "
            "resume=<its folder>"
        )
    if args.config_dir is not None and not Path(args.config_dir).is_dir():
        raise UsageError(f"--config-dir: there is no folder {Path(args.config_dir).absolute()}")
    path = args.config_path
    if path and "://" not in path and not (Path(path).is_absolute() and Path(path).is_dir()):
        raise UsageError(
            f"--config-path should be the absolute path of a folder that holds all configs, not "
            f"'{path}'; --config-dir adds a folder to flowrep's own"
        )
    if args.help:
        return
    if args.resolve and not args.cfg:
        raise UsageError("--resolve says how --cfg and --help show a config: add --cfg job")
    if args.hydra_help:
        return
    if args.package and not args.cfg:
        raise UsageError("--package says which part --cfg shows: add --cfg job")
    tasks = {
        "--run": (args.run, "starts a run"),
        "--multirun": (args.multirun, "starts a sweep"),
        "--cfg": (args.cfg, "shows the config of one run"),
        "--info": (args.info, "shows what a config is made of"),
        "--shell-completion": (args.shell_completion, "completes a line"),
    }
    asked = [f"{flag} {does}" for flag, (given, does) in tasks.items() if given]
    if asked[1:]:
        raise UsageError(f"{', '.join(asked)}: keep one of these flags")
    if args.shell_completion:
        _check_completion(args.overrides)


def _check_completion(words: Sequence[str]) -> None:
    """Refuses what Hydra's completion can't read: its argument, or no line to complete."""
    plugins = Plugins.instance().discover(CompletionPlugin)
    shells = sorted(plugin.provides() for plugin in plugins)  # type: ignore[attr-defined]
    typed = " ".join(words)
    task, _, shell = typed.partition("=")
    if task not in ("install", "uninstall", "query") or shell not in shells:
        raise UsageError(
            "--shell-completion should be followed by install=SHELL, uninstall=SHELL or "
            f"query=SHELL, with {', '.join(shells)} for SHELL, not '{typed}'"
        )
    if task == "query" and not os.environ.get("COMP_LINE", "").strip():
        raise UsageError(
            f"--shell-completion {typed} is for the shell, which sets COMP_LINE to the line to "
            f"complete; --shell-completion install={shell} prints the code that sets it up"
        )
