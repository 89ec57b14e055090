"""Previews what Hydra will compose before it runs anything, to report mistakes in one line.

The preview uses Hydra itself, with the search path and overrides of the run, and so accepts
whatever Hydra accepts: plugins' groups, a user's own configs, `+key=` and `~key`. Only what Hydra
refuses is examined again, to say what is wrong and what exists instead.
"""

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import version
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from flowrep.config import Section, UsageError, validated
from flowrep.config.flags import check_flags, only_shows
from flowrep.config.hydra_mistakes import needs_a_choice, one_line, unknown_choice, unknown_key
from flowrep.config.quoting import override as quoted_override
from flowrep.config.quoting import shell_line
from flowrep.config_tree import CONF_DIR
from flowrep.extras import is_installed

VERSION_BASE = "1.3"  # of Hydra's behaviour, as in the commands' entry points
REFUSALS = (HydraException, OmegaConfBaseException, ValueError)  # the last for `scene=null`


def check_command(
    config_name: str, arguments: Sequence[str], schema: type[Section] | None = None
) -> argparse.Namespace:
    """Refuses a command line that Hydra would refuse, or whose config violates the schema.

    Every value of a sweep is checked before any of its jobs starts.

    Args:
        config_name: a file of conf/, without its ending.
        arguments: as typed, e.g. `["-m", "representations=[ego],[raw]", "seed=1"]`.
        schema: the schema of a job's config.

    Returns:
        The command line as Hydra's parser reads it.

    Raises:
        UsageError: a line for each mistake.
    """
    args = get_args_parser().parse_args(list(arguments))
    check_flags(args)
    if args.shell_completion or (args.hydra_help and not args.overrides):
        return args  # no config is composed
    preview = Preview(args, config_name)
    try:
        parsed = preview.with_sweepers(preview.parse(args.overrides))
        for config in preview.configs(parsed):
            if schema is not None and not only_shows(args):
                validated(schema, config, keys_added(parsed))
    finally:
        GlobalHydra.instance().clear()
    return args


def plain_config(config: DictConfig) -> dict[str, Any]:
    """Returns a composed config as plain data, with interpolations resolved but `???` unchanged.

    Raises:
        UsageError: an interpolation can't be resolved.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise UsageError(one_line(error)) from None
    return plain


def keys_added(overrides: Iterable[Override]) -> set[str]:
    """Returns the top-level keys that overrides add (`+note=pilot`)."""
    added = [o for o in overrides if o.is_add() or o.is_force_add()]
    return {(o.package or o.key_or_group).split(".")[0] for o in added}


def parse(overrides: Iterable[str]) -> list[Override]:
    """Returns overrides as Hydra reads them."""
    return list(OverridesParser.create().parse_overrides(list(overrides)))


class Preview:
    """Hydra as the command will run it, with readable versions of its errors.

    Args:
        args: the parsed command line.
        config_name: the primary config, unless the command line names another.
    """

    def __init__(self, args: argparse.Namespace, config_name: str) -> None:
        self.config_name = config_name if args.config_name is None else args.config_name
        self.only_shows = only_shows(args)
        self.is_multirun = args.multirun and not self.only_shows
        GlobalHydra.instance().clear()
        version.setbase(VERSION_BASE)
        self._hydra = Hydra.create_main_hydra2("flowrep", _search_path(args))
        self._loader = self._hydra.config_loader
        self._typed: list[str] = args.overrides

    def parse(self, overrides: Iterable[str]) -> list[Override]:
        """Returns overrides as Hydra reads them."""
        parsed = []
        for text in overrides:
            try:
                parsed += OverridesParser.create(self._loader).parse_overrides([text])
            except HydraException as error:
                key, _, value = text.partition("=")
                if value and value[0] not in "[{(":
                    remedy = shell_line(quoted_override(key, value))
                    raise UsageError(f"can't read '{text}'; quoted it is {remedy}") from None
                raise UsageError(f"can't read '{text}': {one_line(error)}") from None
        has_mode = any(o.key_or_group == "hydra.mode" for o in parsed)
        if self.only_shows or not (self.is_multirun or has_mode):
            remedy = "give one of them" if self.only_shows else "add -m to run each of them"
            for override in (o for o in parsed if o.is_sweep_override()):
                as_list = f"{override.key_or_group}=[{override.get_value_string()}]"
                raise UsageError(
                    f"'{override.input_line}' is several values: {remedy}, or write {as_list} for "
                    "a list"
                )
        return parsed

    def with_sweepers(self, parsed: Sequence[Override]) -> list[Override]:
        """Returns overrides together with those of `hydra.sweeper.params` in an experiment.

        Typed overrides take precedence.

        Raises:
            UsageError: there are several experiments, and one of them has such overrides.
        """
        if not self.is_multirun:
            return [*parsed]
        for experiment in (o for o in parsed if o.key_or_group == "experiment"):
            names = self._values(experiment)
            others = [self._values(override)[0] for override in parsed if override != experiment]
            if len(names) > 1 and any(self._params([*others, name]) for name in names):
                raise UsageError(
                    f"'{experiment.input_line}' is several experiments, each with runs of its own: "
                    "give each in a command of its own"
                )
        params = self._params([self._values(override)[0] for override in parsed])
        typed = {override.get_key_element() for override in parsed}
        added = [f"{key}={value}" for key, value in params.items() if key not in typed]
        return [*self.parse(added), *parsed]

    def _params(self, job: list[str]) -> Mapping[str, Any]:
        return OmegaConf.select(self._explained_config(job).hydra, "sweeper.params") or {}

    def hydra_config(self, parsed: Sequence[Override]) -> DictConfig:
        """Returns Hydra's own part of the config for the first of a sweep's jobs."""
        return self._explained_config([self._values(override)[0] for override in parsed]).hydra

    def configs(self, parsed: Sequence[Override]) -> Iterator[dict[str, Any]]:
        """Yields plain configs of jobs that together contain each value of each sweep."""
        values = [self._values(override) for override in parsed]
        job = [texts[0] for texts in values]
        first = self.compose(job)
        yield first
        for place, (override, texts) in enumerate(zip(parsed, values)):
            is_choice = bool(texts[1:]) and bool(self._options(override.key_or_group))
            for text in texts[1:]:
                if is_choice:
                    yield self.compose([*job[:place], text, *job[place + 1 :]])
                else:
                    (one,) = parse([text])
                    yield _changed(first, one.key_or_group.split("."), one.value())

    def _values(self, override: Override) -> list[str]:
        """Returns an override for each of its values, or for both ends of an interval."""
        if not override.is_sweep_override():
            return [str(override.input_line)]
        key = override.get_key_element()
        if override.is_interval_sweep():
            interval: Any = override.value()
            return [f"{key}={interval.start}", f"{key}={interval.end}"]
        return [f"{key}={text}" for text in override.sweep_string_iterator()]

    def compose(self, job: list[str]) -> dict[str, Any]:
        """Returns the config of a job, without Hydra's own part."""
        config = self._explained_config(job)
        with open_dict(config):
            del config["hydra"]
        return plain_config(config)

    def _explained_config(self, job: list[str]) -> DictConfig:
        """Returns the config of a job; explains what Hydra refuses."""
        try:
            config = self._compose(job)
        except REFUSALS as error:
            raise UsageError(self._explained(error, parse(job))) from None
        _check_plugins(config.hydra)
        _check_scene_name(config, job, self._options("scene"))
        return config

    def _compose(self, job: list[str]) -> DictConfig:
        return self._hydra.compose_config(
            self.config_name, job, run_mode=RunMode.RUN, with_log_configuration=False
        )

    def _explained(self, error: Exception, overrides: Sequence[Override]) -> str:
        """Returns what is wrong with overrides that Hydra refuses, and what exists instead."""
        if isinstance(error, MissingConfigException) and error.options is not None:
            group, _, name = str(error.missing_cfg_file).rpartition("/")
            return unknown_choice(group, name, error.options)
        missing = re.match(r"You must specify '([^']+)'", one_line(error))
        if missing:
            return needs_a_choice(missing[1], self._options(missing[1]))
        one_of_several = re.match(r".*Could not load '(.+)/([^/']+)'", one_line(error))
        if one_of_several:
            group, name = one_of_several.groups()
            return unknown_choice(group, name, self._options(group))
        for override in overrides:
            options = self._options(override.key_or_group)
            if options and override.value() is None and not override.is_delete():
                return f"{override.key_or_group} should be one of: {', '.join(options)}, not null"
            if options and override.is_delete():
                return needs_a_choice(override.key_or_group, options)
        groups = [o for o in overrides if self._options(o.key_or_group)]
        try:
            config = self._compose([str(o.input_line) for o in groups])
        except REFUSALS:
            return one_line(error)
        for override in overrides:
            if override not in groups and override.type in (OverrideType.CHANGE, OverrideType.DEL):
                unknown = unknown_key(override.key_or_group, config, self._loader.list_groups(""))
                if unknown:
                    return unknown
        return one_line(error)

    def _options(self, group: str) -> list[str]:
        """Returns the choices of a group, none if there is no such group."""
        return self._loader.get_group_options(
            group, config_name=self.config_name, overrides=self._searchpath()
        )

    def _searchpath(self) -> list[str]:
        return [text for text in self._typed if text.startswith("hydra.searchpath=")]


def _changed(config: dict[str, Any], keys: Sequence[str], value: Any) -> dict[str, Any]:
    """Returns a config with `value` at `keys`; unchanged parts are shared."""
    key, *rest = keys
    if not rest:
        return config | {key: value}
    section = config.get(key)
    return config | {key: _changed(section if isinstance(section, dict) else {}, rest, value)}


def _search_path(args: argparse.Namespace) -> ConfigSearchPathImpl:
    """Returns Hydra's search path: conf/, plugins, and the folder of `--config-dir`."""
    path: Any = create_config_search_path(args.config_path or str(CONF_DIR))
    if args.config_dir is not None:
        folder = f"file://{Path(args.config_dir).absolute()}"
        path.prepend("command-line", folder, SearchPathQuery(provider="schema"))
    return path


def _check_plugins(hydra: DictConfig) -> None:
    """Refuses a launcher or sweeper of `conf/hydra/` whose package is not installed."""
    for part in ("launcher", "sweeper"):
        package = ".".join(str(hydra[part]["_target_"]).split(".")[:2])
        if package.startswith("hydra_plugins.") and not is_installed(package):
            name = package.split(".")[1].replace("_", "-")
            raise UsageError(
                f"hydra/{part}={hydra.runtime.choices[f'hydra/{part}']} needs a package that is "
                f"not installed: pip install {name}"
            )


def _check_scene_name(config: DictConfig, job: Iterable[str], scenes: Iterable[str]) -> None:
    """Refuses a scene file with the name of another, as a copy has, unless the name is typed."""
    choice, name = config.hydra.runtime.choices.get("scene"), OmegaConf.select(config, "scene.name")
    if not choice or name is None or any(o.key_or_group == "scene.name" for o in parse(job)):
        return
    own = choice.rpartition("/")[2]
    if name != own and name in scenes:
        raise UsageError(
            f"scene={choice} has the name '{name}', under which its results would be filed: write "
            f"name: {own} in its file, or add scene.name={own}"
        )
