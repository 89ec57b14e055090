"""Runs a command from its command line; a mistake ends in `error:` lines and exit code 2.

Hydra composes the config and pydantic checks it. Their messages are printed as they are, each as a
line that names the key; with `HYDRA_FULL_ERROR=1`, tracebacks are printed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from functools import wraps
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.utils import env_override
from hydra.errors import HydraException, MissingConfigException
from hydra.initialize import get_gh_backup, restore_gh_from_backup
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from flowrep import __version__
from flowrep.config import CONF_DIR, config_groups, group_choices
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.config_dir import checked_files
from flowrep.config.options import Command, Model, validated
from flowrep.config.run_names import register_resolvers
from flowrep.config.usage import UsageError, closest_first

EXIT_USAGE = 2
_OF_JOB = "flowrep_job"  # an attribute of errors that a command raised, not Hydra's reading
FOLDERS = ("resume", "run", "input", "output", "hydra.run.dir", "hydra.sweep.dir")
"""Keys whose values are folders, whose names may have any characters."""
IS_DEBUGGING = bool(os.environ.get("HYDRA_FULL_ERROR"))


def run_command(config_name: str, command: Callable[[Any], Any], schema: type[Command]) -> None:
    """Composes the config of `sys.argv` from conf/, and runs the command on its model."""

    def job(config: DictConfig) -> Any:
        try:
            return command(checked(config, schema))
        except Exception as error:  # caught here, since Hydra would print another line
            end_with(error)

    run_hydra(config_name, job, schema)


def run_hydra(config_name: str, job: Callable[[DictConfig], Any], schema: type[Command]) -> None:
    """Runs a Hydra job; what Hydra refuses ends the process in an `error:` line."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace", line_buffering=True)
    if not sys.flags.safe_path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for policies and classes in modules there, as with -m
    _show_if_asked(sys.argv[1:], config_name)
    main = hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=config_name)

    @wraps(job)
    def marked(config: DictConfig) -> None:
        try:
            job(config)
        except Exception as error:
            error.__dict__[_OF_JOB] = True
            raise

    try:
        typed = sys.argv[1:] = as_typed(sys.argv[1:], schema)
        with _composing(typed), env_override({"HYDRA_FULL_ERROR": "1"}):  # raise, don't print
            main(marked)()
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        end_with(error)


@contextmanager
def _composing(typed: Sequence[str]) -> Iterator[None]:
    """Makes Hydra read only plain data from others' files, and its errors name what was typed."""
    register_resolvers()
    try:
        with checked_files():
            yield
    except Exception as error:
        # A job ends with its own errors. The others are of a line of which Hydra can't make a
        # config, for instance since there is a list where it expects a name, and of any class.
        if _OF_JOB in error.__dict__ or isinstance(error, UsageError):
            raise
        text = explained(error)
        is_of_hydra = isinstance(error, HydraException | OmegaConfBaseException)
        if isinstance(error, OSError) and not is_of_hydra:
            text += ": give another folder with hydra.run.dir="
        elif not isinstance(error, MissingConfigException) and not any(x in text for x in typed):
            remedy = "" if is_of_hydra else "; a choice is a name or a list of names"
            text = f"{shlex.join(typed)}: {text}{remedy}"
        raise UsageError(text) from error


def composed(schema: type[Model], values: Mapping[str, Any]) -> tuple[Model, str]:
    """Returns the config of a training from Python, and the folder that `flowrep.train` takes."""
    typed = list(_overrides(values))
    outer = get_gh_backup()  # of the script that calls, which may use Hydra itself
    GlobalHydra.instance().clear()
    try:
        with _composing(typed), hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            config = hydra.compose("train", typed, return_hydra_config=True)
            return checked(config, schema), str(config.hydra.run.dir)
    finally:
        restore_gh_from_backup(outer)


def _overrides(values: Mapping[str, Any], section: str = "") -> Iterator[str]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            if f"{section}{key}" == "representations":  # these and no others
                yield f"representations=[{','.join(value)}]"
            yield from _overrides(value, f"{section}{key}.")
        elif isinstance(value, str | Path):
            yield override(f"{section}{key}", str(value))
        else:
            try:
                yield f"{section}{key}={json.dumps(value)}"
            except TypeError as error:  # numpy's numbers and the like
                raise UsageError(f"{section}{key}: {error}") from None


def checked(config: DictConfig, schema: type[Model]) -> Model:
    """Returns a composed config as its model; keys that the user added (`+note=pilot`) pass."""
    job = config.get("hydra") or HydraConfig.get()
    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    plain: Any = OmegaConf.to_container(own, resolve=True, throw_on_missing=True)
    model: Any = validated(schema, plain)
    _check_no_file_is_hidden(job)
    typed = job.overrides.task
    for given in filter(None, map(parsed, typed)):
        names: Any = given.value() if given.key_or_group in config_groups() else None
        for i, name in enumerate(names if isinstance(names, list) else ()):
            if name in names[:i]:  # Hydra would read its file once
                raise UsageError(f"{given.input_line}: {name} is given twice; leave one out")
    if job.sweeper.params and job.mode != RunMode.MULTIRUN:
        raise UsageError(
            f"{', '.join(job.sweeper.params)}: the experiment lists runs, which need -m; without "
            "it, a single run would leave the list out"
        )
    # The schema keeps unknown keys for who adds one by `+note=pilot`, not for a file's typo.
    keys = [text.partition("=")[0].rpartition("@")[2] for text in typed]  # +group@key=choice
    for key in (model.model_extra or {}).keys() - {key.lstrip("+").split(".")[0] for key in keys}:
        raise UsageError(f"{key}: there is no such key; do you mean one of its sections'?")
    # Wherever it was typed: as a value, in a section or in a list.
    words = {word for text in typed if "_target_" in text for word in re.split(r"[^\w.]", text)}
    for key, target in model.classes.items():
        if target not in (*ALGORITHMS, *words):
            raise UsageError(
                f"{key}={target} is code outside of flowrep, which a file can't have run: if you "
                f"trust it, add {key}={target}"
            )
    choice = str(job.runtime.choices.get("scene") or "").rpartition("/")[2]
    name = (plain.get("scene") or {}).get("name")
    is_typed = any(text.startswith("scene.name=") for text in typed)
    if name and choice not in ("", name) and not is_typed:
        raise UsageError(
            f"scene={choice} has the name '{name}', under which its results would be filed: write "
            f"name: {choice} in its file, or add scene.name={choice}"
        )
    return model


def _check_no_file_is_hidden(job: Any) -> None:
    """Checks that no choice is a file of the user's that Hydra finds in flowrep's folder first."""
    folders = [Path(each.path) for each in job.runtime.config_sources if each.schema == "file"]
    later = folders[folders.index(CONF_DIR) + 1 :] if CONF_DIR in folders else []
    for group, choice in job.runtime.choices.items():
        names = [choice] if isinstance(choice, str) else choice or []
        for folder, name in product(later, names):
            path = f"{group.partition('@')[0]}/{name}.yaml"
            file, ours = folder / path, CONF_DIR / path
            are_there = file.is_file() and ours.is_file()
            if are_there and file.read_bytes() != ours.read_bytes():
                why = "because flowrep has a file of the same name: rename yours"
                raise UsageError(f"{file} would be ignored, {why}")


# Mistakes.


def end_with(error: Exception) -> NoReturn:
    """Ends the process, with the line of a mistake or the traceback of a bug."""
    if IS_DEBUGGING or not is_a_mistake(error):
        traceback.print_exception(error)
        sys.exit(1)
    exit_with(explained(error))


def is_a_mistake(error: Exception) -> bool:
    """Returns whether an error is about something that a user can change."""
    # A launcher raises BrokenExecutor if its worker was killed, for instance for lack of memory.
    libraries = HydraException, OmegaConfBaseException, YAMLError, BrokenExecutor
    is_ours = type(error).__module__.startswith("flowrep.") or _is_out_of_memory(error)
    return isinstance(error, (*libraries, ValueError, ImportError, OSError)) or is_ours


def _is_out_of_memory(error: Exception) -> bool:
    # PyTorch's error on a CPU has no class of its own; numpy and numba raise a MemoryError.
    is_gpu = type(error).__name__ == "OutOfMemoryError"
    is_cpu = isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
    return isinstance(error, MemoryError) or is_gpu or is_cpu


def explained(error: Exception) -> str:
    """Returns an error's line; for an unknown choice, with the known ones."""
    if _is_out_of_memory(error):
        reason = str(error).partition("\n")[0] or "MemoryError"
        remedy = "use fewer envs, or a smaller camera, network or replay_capacity"
        return f"out of memory ({reason}): {remedy}"
    if isinstance(error, MissingConfigException) and "/" in str(error.missing_cfg_file):
        group, _, name = str(error.missing_cfg_file).removesuffix(".yaml").rpartition("/")
        there = closest_first(name, error.options or group_choices(group))
        return (
            f"unknown {group} '{name}'; there are: {there}. To add it, create {group}/{name}.yaml "
            "in a folder and name the folder with --config-dir"
        )
    if isinstance(error, HydraException | OmegaConfBaseException | YAMLError):
        return " ".join(str(error).split())
    return str(error)


def exit_with(problem: str | Exception, remedy: str = "") -> NoReturn:
    """Ends the process with the exit code of a usage error, printing each line of the problem."""
    print_error(problem)
    if remedy:  # no `error:` line: a sweep takes the last of those for the reason of a failure
        print(remedy, file=sys.stderr)
    sys.exit(EXIT_USAGE)


def print_error(problem: str | Exception) -> None:
    """Prints each line of a problem."""
    for line in str(problem).splitlines():
        print(f"error: {line}", file=sys.stderr)


# Texts with any characters, for Hydra and the shell.


def as_typed(arguments: Sequence[str], schema: type[Command]) -> list[str]:
    """Returns a command line for Hydra: folders are quoted; those without a key get `run`."""
    folders, others, previous = [], [], ""
    for text in arguments:
        key, _, value = text.partition("=")
        # Neither a flag nor the value of one, as of `--config-dir mine`.
        is_argument = text[:1] not in "-~+" and not previous.startswith("-")
        # Not Path's: it raises for what is longer than a file's name.
        names_run = text == key or os.path.exists(text)
        if is_argument and "run" in schema.model_fields and names_run:
            folders.append(override("run", text).removeprefix("run="))
        else:
            home = os.path.expanduser(value)  # a shell keeps the ~ in `hydra.run.dir=~/x`
            others.append(override(key, home) if _is_folder(key, value) else text)
        previous = text
    if folders and any(text.startswith("run=") for text in others):
        raise UsageError(f"{folders[0]} and run= both name folders: leave out run=")
    run = f"[{','.join(folders)}]" if folders[1:] else "".join(folders)
    return [f"run={run}", *others] if folders else others


def _is_folder(key: str, value: str) -> bool:
    """Returns whether a value is the name of a folder, not yet in quotes."""
    is_camera = key == "input" and value.isdigit()
    is_for_hydra = value[:1] in ("", "[", "'", '"') or value in ("null", "???") or "${" in value
    return key in FOLDERS and (os.path.exists(value) or not (is_camera or is_for_hydra))


def typed_keys() -> set[str]:
    """Returns the keys on the line of a command that is running, such as `scene.camera.fov_deg`."""
    typed = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    return {text.lstrip("+").partition("=")[0] for text in typed}


def value_of(text: str) -> str:
    """Returns the value of an override as text, without Hydra's quotes."""
    read = parsed(text)
    return text.partition("=")[2] if read is None else str(read.value())


def parsed(text: str) -> Any:
    """Returns an override as Hydra reads it, None if it can't."""
    try:
        return OverridesParser.create().parse_overrides([text])[0]
    except HydraException:
        return None


def override(key: str, text: str) -> str:
    """Returns an override that sets `key` to exactly `text`, quoted only if necessary."""
    read = None if "${" in text else parsed(f"{key}={text}")
    if read is not None and read.value() == text:
        return f"{key}={text}"
    # OmegaConf would replace an interpolation, and takes backslashes before one as escapes.
    text = re.sub(r"(\\*)\$\{", lambda match: match[1] * 2 + r"\${", text)
    return f"{key}={QuotedString(text, Quote.single).with_quotes()}"


def line_for(command: str, **values: str) -> str:
    """Returns a shell line for a command, called as this one: as script or module."""
    is_script = Path(sys.argv[0]).name.startswith("flowrep-")
    program = [f"flowrep-{command}"] if is_script else ["python", "-m", f"flowrep.{command}"]
    return shlex.join([*program, *(override(key, text) for key, text in values.items())])


def _show_if_asked(arguments: Sequence[str], config_name: str) -> None:
    """Ends the process after --version or --help, which prints the command's file of conf/."""
    if "--version" in arguments:
        print(f"flowrep {__version__}")
        sys.exit(0)
    if {"--help", "-h"} & {*arguments}:
        text, _, _ = (CONF_DIR / f"{config_name}.yaml").read_text("utf-8").partition("\nhydra:")
        print(re.sub(r"(?m)^ +- (_self_|override|optional|run_folder).*\n", "", text).rstrip())
        print("\nkey=value sets a key, group=choice chooses, -m runs each of several values.")
        print("--cfg job shows all keys, --hydra-help Hydra's own flags. The groups' choices:")
        for group in config_groups():
            print(f"  {group}: {', '.join(group_choices(group))}")
        sys.exit(0)
