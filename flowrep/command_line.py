"""The command line's manners: a mistake ends in one line that names it and lists what exists."""

import difflib
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flowrep.config import Section, UsageError, validated
from flowrep.config_tree import CONF_DIR, config_groups, group_choices

EXIT_USAGE = 2
MULTIRUN = ("-m", "--multirun")


def register_resolvers() -> None:
    """Adds `${run_name:scene,representations,flow,seed}`, which run folders are named by."""

    def run_name(scene: str, representations: Iterable[str], flow: str, seed: int) -> str:
        source = "" if flow == "exact" else f"_{flow}"
        return f"{scene}_{'+'.join(representations)}{source}_s{seed}"

    OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def exit_with(message: str) -> NoReturn:
    """Ends the process with the exit code of a wrong command, each line saying what is wrong."""
    for line in message.splitlines():
        print(f"error: {line}", file=sys.stderr)
    sys.exit(EXIT_USAGE)


def plain_config(config: DictConfig) -> dict[str, Any]:
    """Returns a composed config as plain data, interpolations resolved, `???` left as it is.

    Raises:
        UsageError: an interpolation leads nowhere.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise UsageError(_first_line(error)) from None
    return plain


def own_keys() -> set[str]:
    """Returns the top level's keys that were added to the running job's config: `+note=pilot`."""
    return keys_added(OverridesParser.create().parse_overrides(HydraConfig.get().overrides.task))


def keys_added(overrides: Iterable[Override]) -> set[str]:
    """Returns the top level's keys that overrides add."""
    return {o.key_or_group.split(".")[0].split("@")[0] for o in overrides if o.is_add()}


def run_command(config_name: str, command: Callable[[], Any], schema: type[Section]) -> None:
    """Runs a Hydra entry point after checking its overrides, so that mistakes read well.

    Args:
        config_name: a file of conf/, without its ending.
        command: the entry point.
        schema: what the composed config may hold.
    """
    register_resolvers()
    arguments = sys.argv[1:]
    if not any(argument.startswith("-") and argument not in MULTIRUN for argument in arguments):
        try:
            check_overrides(config_name, [a for a in arguments if a not in MULTIRUN], schema)
        except UsageError as error:
            exit_with(str(error))
    command()


def check_overrides(
    config_name: str, overrides: Sequence[str], schema: type[Section] | None = None
) -> None:
    """Refuses overrides that name what doesn't exist, or give what can't be.

    Every value of a sweep is looked at, before any of its jobs starts.

    Args:
        config_name: a file of conf/, without its ending.
        overrides: as typed, e.g. `["representations=[ego]", "seed=1"]`.
        schema: what the composed config may hold.

    Raises:
        UsageError: an unknown group choice, an unknown key, text that Hydra can't read, or a value
            that the schema refuses.
    """
    parsed = []
    for text in overrides:
        try:
            parsed += OverridesParser.create().parse_overrides([text])
        except HydraException as error:
            raise UsageError(f"can't read '{text}': {_first_line(error)}") from None
    groups = config_groups()
    chosen = [override for override in parsed if override.key_or_group in groups]
    for override in chosen:
        for choice in _choices(override):
            _check_known(choice, group_choices(override.key_or_group), override.key_or_group)
    config = _compose(config_name, [_one_value(override) for override in chosen])
    for override in parsed:
        if override.type is OverrideType.CHANGE and override not in chosen:
            _check_key(override.key_or_group, config)
    composed = _compose(config_name, [_one_value(o) for o in parsed])
    if schema is not None:
        validated(schema, plain_config(composed), keys_added(parsed))


def _choices(override: Override) -> list[str]:
    """The group choices that an override names, those of every job where it sweeps."""
    values = list(override.sweep_iterator()) if override.is_sweep_override() else [override.value()]
    flat: list[Any] = []
    for value in values:
        value = _unquoted_list(value) if isinstance(value, str) else value
        flat += value if isinstance(value, list) else [value]
    return [str(choice) for choice in flat if choice is not None]


def _unquoted_list(text: str) -> str | list[str]:
    """A sweep hands lists on as text: '[ego,obj]'."""
    return text[1:-1].split(",") if text.startswith("[") and text.endswith("]") else text


def _one_value(override: Override) -> str:
    """An override as text, the first value of it where it sweeps."""
    if not override.is_sweep_override():
        return str(override.input_line)
    return f"{override.key_or_group}={next(iter(override.sweep_string_iterator()))}"


def _check_known(name: str, known: Sequence[str], what: str) -> None:
    if name not in known:
        raise UsageError(
            f"unknown {what} '{name}'{_closest(name, known)}; there are: {', '.join(known)}"
        )


def _check_key(key: str, config: DictConfig) -> None:
    """Walks a dotted key down the composed config and names the first part that isn't there."""
    node: Any = config
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if part == "hydra" and depth == 0:
            return
        known = [str(name) for name in node] if isinstance(node, DictConfig) else []
        if not depth:
            known += [group for group in config_groups() if group not in known]
        if part not in known:
            where = f" of '{'.'.join(parts[:depth])}'" if depth else ""
            there = f"there are: {', '.join(known)}" if known else "it has no keys"
            raise UsageError(f"unknown key '{part}'{where}{_closest(part, known)}; {there}")
        node = OmegaConf.select(node, part)


def _compose(config_name: str, overrides: list[str]) -> DictConfig:
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            return compose(config_name, overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise UsageError(_first_line(error)) from None


def _closest(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]
