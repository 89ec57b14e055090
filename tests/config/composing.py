"""Composed configs for tests, each choice of groups composed once."""

import functools
from pkgutil import resolve_name

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf, open_dict

from flowrep.config import CONF_DIR, config_groups
from flowrep.config.options import validated
from flowrep.config.run_names import register_resolvers

SCHEMAS = {
    "train": "flowrep.experiment.schema:TrainConfig",
    "evaluate": "flowrep.experiment.schema:EvaluateConfig",
    "view": "flowrep.experiment.schema:ViewConfig",
    "factorize": "flowrep.factorize:FactorizeConfig",
    "report": "flowrep.report.__main__:ReportConfig",
}


def schema_of(command):
    return resolve_name(SCHEMAS[command])


@functools.cache
def _composed(name, choices):
    register_resolvers()
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return compose(name, list(choices))


def plain(name, *overrides):
    """Returns what Hydra composes of a command's config, as plain data.

    Values are set in a copy of what was composed for the same choices, as Hydra does, but faster.
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    groups = config_groups()
    choices = [o for o in parsed if o.key_or_group in groups or "searchpath" in o.key_or_group]
    config = _composed(name, tuple(o.input_line for o in choices)).copy()
    with open_dict(config):
        for override in (o for o in parsed if o not in choices):
            if override.is_delete():
                section, _, key = override.key_or_group.rpartition(".")
                del (OmegaConf.select(config, section) if section else config)[key]
            else:
                OmegaConf.update(config, override.key_or_group, override.value())
    return OmegaConf.to_container(config, resolve=True)


def config_of(command, *overrides):
    """Returns the config of a command as its model."""
    return validated(schema_of(command), plain(command, *overrides))


composed = functools.partial(config_of, "train")
