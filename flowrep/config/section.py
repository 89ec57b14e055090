"""The base of all sections of a config: no key is unknown, and none is missing."""

from collections.abc import Collection, Mapping
from typing import Any, TypeVar

from omegaconf import MISSING
from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from flowrep.config.violations import (
    ABSENT,
    UNKNOWN,
    UsageError,
    broken_rule,
    closest,
    lines_of,
    shown,
)

S = TypeVar("S", bound="Section")


class Section(BaseModel):
    """Keys of a config; a subclass annotates each with its permitted values.

    Nothing has a default here, since defaults belong in conf/.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, validate_default=False)

    @classmethod
    def keys(cls) -> list[str]:
        """Returns the keys as they are written in a config."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @model_validator(mode="before")
    @classmethod
    def _has_its_keys(cls, value: Any, info: ValidationInfo) -> Any:
        known = cls.keys()
        if not isinstance(value, Mapping):
            keys = f"a section with the keys {', '.join(known)}" if known else "a section: {}"
            raise broken_rule("", f"should be {keys}, not {shown(value)}")
        for key in value:
            if key not in known and cls.model_config["extra"] == "forbid":
                there = f"there are: {', '.join(known)}" if known else "it has none"
                remedy = f"{closest(str(key), known)}; {there}"
                raise PydanticCustomError(UNKNOWN, "{remedy}", {"key": key, "remedy": remedy})
        for name, field in cls.model_fields.items():
            key = field.alias or name
            if field.is_required() and (key not in value or value[key] == MISSING):
                example = (field.examples or ["..."])[0]
                raise PydanticCustomError(ABSENT, "{example}", {"key": key, "example": example})
        return value


class ChosenBy:
    """Annotates a field whose section is chosen by one of the section's own keys.

    Args:
        key: the key that chooses, e.g. `_target_`.
        sections: the sections by the key's value.
        otherwise: the section for any other value.
    """

    def __init__(
        self, key: str, sections: Mapping[str, type[Section]], otherwise: type[Section]
    ) -> None:
        self.key, self.sections, self.otherwise = key, sections, otherwise

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Returns a union of all sections, told apart by the key."""
        choices = {f"@{name}": handler.generate_schema(s) for name, s in self.sections.items()}
        choices["@"] = handler.generate_schema(self.otherwise)
        return core_schema.tagged_union_schema(choices, discriminator=self._choice)

    def _choice(self, value: Any) -> str:
        name = value.get(self.key) if isinstance(value, Mapping) else None
        return f"@{name}" if isinstance(name, str) and name in self.sections else "@"


def validated(schema: type[S], config: Mapping[str, Any], own_keys: Collection[str] = ()) -> S:
    """Returns a valid config as its schema.

    Args:
        schema: the schema of the whole config.
        config: the resolved config as plain data.
        own_keys: top-level keys that the user added (`+note=pilot`).

    Raises:
        UsageError: a line for each key that is unknown, missing or invalid.
    """
    not_checked = set(own_keys) - set(schema.keys())
    if not_checked:
        config = {key: value for key, value in config.items() if key not in not_checked}
    try:
        return schema.model_validate(config)
    except ValidationError as error:
        raise UsageError("\n".join(lines_of(error))) from None
