"""What the models of configs have in common: their base class, types, and the lines of errors."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model

from flowrep.config.usage import UsageError

SpeedMode = Literal["low", "normal", "high"]
"""How fast pedestrians walk; each scene has the speeds."""
FRAME_RATES_HZ = (0.5, 1_000.0)  # lowest and highest
BaselineName = Literal["never_turn", "random", "planner", "speed_blind"]

# Larger whole numbers are not exact as floats.
Count = Annotated[int, Field(ge=1, le=2**53)]
CountOrZero = Annotated[int, Field(ge=0, le=2**53)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
Text = Annotated[str, Field(min_length=1)]
CLASS = r"^\w+(\.\w+)+$"  # package.module.Class


def _distinct(values: Any) -> Any:
    if isinstance(values, tuple):  # from Python; a config has lists
        values = [*values]
    # Not by a set: a wrong value may be a list, which has no hash.
    if isinstance(values, list) and any(x in values[:i] for i, x in enumerate(values)):
        raise ValueError("a value is repeated")
    return values


Distinct = BeforeValidator(_distinct)
OneOrMore = BeforeValidator(lambda x: x if isinstance(x, list) or x is None else [x])
"""Lets a list of one be written without brackets."""


class Options(BaseModel):
    """Named values: unknown names are refused, types are strict, and values can't be changed."""

    # Strict, as pydantic would take "1" and true for the number 1.
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """Returns names and values as in a config."""
        return self.model_dump(by_alias=True)


class FlowOptions(Options):
    """The source of raw flow; further options are those of `flowrep.transforms.EstimatedFlow`."""

    model_config = ConfigDict(extra="allow")
    source: Literal["exact", "estimated"]


class Command(Options):
    """The whole config of a command; it keeps keys that it doesn't know, such as `+note=pilot`."""

    model_config = ConfigDict(extra="allow")

    @property
    def classes(self) -> dict[str, str]:
        """The classes that algorithm and representations name, by the keys that name them."""
        plain = self.plain()
        sections = {"algorithm": plain.get("algorithm") or {}}
        for name, options in (plain.get("representations") or {}).items():
            sections[f"representations.{name}"] = options
        named = {f"{key}._target_": each.get("_target_") for key, each in sections.items()}
        return {key: target for key, target in named.items() if target}

    @property
    def trusted(self) -> list[str]:
        """The classes that it names; a stored run may name these, too."""
        return [*self.classes.values()]


Model = TypeVar("Model", bound=BaseModel)


def validated(schema: type[Model], plain: Mapping[str, Any], source: str = "") -> Model:
    """Returns a resolved config as its model; `source`, a file, begins the lines of an error."""
    try:
        return schema.model_validate(plain)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        if source and (absent := [_key(each) for each in errors if each["type"] == "missing"]):
            raise UsageError(f"{source} lacks {', '.join(absent)}; restore the file") from None
        lines = map(_line, errors)
        raise UsageError("\n".join(f"{source}: {x}" if source else x for x in lines)) from None


def check_reader_options(reader: type, options: Mapping[str, Any]) -> None:
    """Checks the section `format` against the reader's parameters, except for the first one."""
    # Not ???, which would not replace the value of the format that this one extends.
    for key in [key for key, value in options.items() if value == "needed"]:
        raise UsageError(f"format.{key} needs a value: format.{key}=...")
    validated(_section(reader), {"format": options})


@cache  # the model takes longer to make than its check
def _section(reader: type) -> type[BaseModel]:
    hints = get_type_hints(reader.__init__, include_extras=True)  # type: ignore[misc]
    _, *parameters = inspect.signature(reader).parameters.values()
    fields: dict[str, Any] = {
        p.name: (hints[p.name], ... if p.default is p.empty else p.default) for p in parameters
    }
    section: Any = create_model(reader.__name__, __base__=Options, **fields)
    return create_model("Config", format=(section, ...))


def _key(details: Any) -> str:
    # pydantic puts the tag of a union's member, such as an algorithm's class, between the keys.
    keys = [part for part in details["loc"] if isinstance(part, int) or part.isidentifier()]
    return ".".join(map(str, keys))


def _line(details: Any) -> str:
    """Returns one of pydantic's errors as a line that begins with the key."""
    key, message = _key(details), details["msg"].removeprefix("Value error, ")
    if details["type"] == "value_error":
        names_itself = key == "" or message.startswith(f"{key} ")  # as those of a scene do
        return message if names_itself else f"{key}: {message}"
    is_key = details["type"] in ("missing", "extra_forbidden")
    given = "" if is_key else f", not {details['input']!r:.60}"
    return f"{key}: {message[0].lower()}{message[1:]}{given}"
