"""Runs a command from its command line; a mistake ends in one line that lists the choices."""

import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flowrep.config import Section, UsageError
from flowrep.config.composition import check_command, keys_added, parse, plain_config
from flowrep.config.flags import only_shows
from flowrep.config.quoting import override, shell_line, taken_as_typed
from flowrep.config.run_names import run_of_sweep
from flowrep.console import end_when_unread, ended_by_signals, exit_unread

__all__ = [
    "exit_with",
    "line_for",
    "own_keys",
    "plain_config",
    "print_error",
    "register_resolvers",
    "run_command",
    "typed_value",
]

EXIT_USAGE = 2
FOLDERS = ("resume", "run", "input", "output")
"""Keys whose values are folders, which may have any name."""
CAMERAS = ("input",)
"""Those of them that may also be a camera's number."""


def register_resolvers() -> None:
    """Adds the resolvers for paths of run folders in conf/run_folder.yaml and conf/view.yaml.

    `${run_name:scene,representations,flow,noise,seed}` names a run; `${folder_name:text}` makes any
    text the name of a single folder; `${run_of_sweep:overrides}` names a run of a sweep.
    """

    def run_name(
        scene: str,
        representations: Iterable[str],
        flow: str,
        noise: Mapping[str, float],
        seed: int,
    ) -> str:
        source = "" if flow == "exact" else f"_{flow}"
        source += "_noisy" if any(noise.values()) else ""
        return folder_name(f"{scene}_{'+'.join(representations)}{source}_s{seed}")

    OmegaConf.register_new_resolver("run_name", run_name, replace=True)
    OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)
    OmegaConf.register_new_resolver("run_of_sweep", run_of_sweep, replace=True)


def folder_name(text: str) -> str:
    """Returns a text as the name of a single folder, without path separators.

    >>> folder_name("s_turn"), folder_name("../../etc"), folder_name("..")
    ('s_turn', '.._.._etc', '_')
    """
    name = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in str(text))[:200]
    return "_" if name in ("", ".", "..") else name


def exit_with(problem: str | Exception, remedy: str = "") -> NoReturn:
    """Ends the process with the exit code of a usage error, printing each line of the problem.

    Prints nothing if the problem is that the process's output is no longer read.

    Args:
        problem: what is wrong.
        remedy: a line to print after it; the last `error:` line of a sweep's job is its reason.
    """
    if isinstance(problem, BrokenPipeError):
        exit_unread()
    print_error(problem)
    if remedy:
        print(remedy, file=sys.stderr)
    sys.exit(EXIT_USAGE)


def print_error(problem: str | Exception) -> None:
    """Prints each line of a problem, without ending the process."""
    for line in str(problem).splitlines():
        print(f"error: {line}", file=sys.stderr)


def line_for(command: str, **values: str) -> str:
    """Returns a shell line for a flowrep command, called in the same way as this one.

    Args:
        command: the command's name, e.g. "train".
        values: the values of its keys, with any characters.
    """
    is_script = Path(sys.argv[0]).name.startswith("flowrep-")
    program = [f"flowrep-{command}"] if is_script else ["python", "-m", f"flowrep.{command}"]
    return shell_line(*program, *(override(key, text) for key, text in values.items()))


def own_keys() -> set[str]:
    """Returns the top-level keys that were added to the running job's config (`+note=pilot`).

    Outside a job there are none.
    """
    if not HydraConfig.initialized():
        return set()
    return keys_added(parse(HydraConfig.get().overrides.task))


def typed_value(key: str) -> Any:
    """Returns a key's value on the command line, None if it was not given."""
    typed = [a for a in taken_as_typed(sys.argv[1:], FOLDERS, CAMERAS) if a.startswith(f"{key}=")]
    if not typed:
        return None
    try:
        (last,) = parse(typed[-1:])
        return OmegaConf.create([last.value()])[0]
    except (HydraException, OmegaConfBaseException):
        return None  # the check of the whole line reports the error


def run_command(config_name: str, command: Callable[[], Any], schema: type[Section]) -> None:
    """Runs a Hydra entry point after checking its command line, so that mistakes read well.

    Args:
        config_name: a file of conf/, without its ending.
        command: the entry point.
        schema: the schema of the composed config.
    """
    register_resolvers()
    sys.argv[1:] = taken_as_typed(sys.argv[1:], FOLDERS, CAMERAS)
    with ended_by_signals():
        try:
            args = check_command(config_name, sys.argv[1:], schema)
        except UsageError as error:
            exit_with(error)
        if only_shows(args):
            end_when_unread()
        try:
            with env_override({"HYDRA_FULL_ERROR": "1"}):  # Hydra raises errors, not prints them
                command()
        except BrokenPipeError as error:
            exit_with(error)
        except OSError as error:  # commands print their own
            exit_with(
                f"the output folder can't be made ({error}): give another with hydra.run.dir="
            )
