"""Schemas of the commands' configs; see `flowrep.config.section` and docs/configs.md."""

from flowrep.config.section import Section, validated
from flowrep.config.violations import UsageError

__all__ = ["Section", "UsageError", "validated"]
