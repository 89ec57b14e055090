"""The permitted values of a config, checked by pydantic and described in words.

Each class here annotates a field of a section:

>>> from typing import Annotated
>>> from flowrep.config.section import Section, validated
>>> class Learner(Section):
...     gamma: Annotated[float, Number(least=0, most=1)]
>>> validated(Learner, {"gamma": 2})
Traceback (most recent call last):
    ...
flowrep.config.violations.UsageError: gamma should be a number from 0 to 1, not 2

Types are strict: `true` is not a number, 1.5 is not a whole number, and nan and infinity are always
invalid.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from flowrep.config.violations import EXPECTED

LARGEST = 2**53  # larger whole numbers are not exact as floats


@dataclass(frozen=True)
class Expectation(ABC):
    """The permitted values of a field; `also` are further single values that it may have."""

    also: tuple[str | None, ...] = field(default=(), kw_only=True)

    @abstractmethod
    def _schema(self) -> CoreSchema:
        """Returns pydantic's schema, without `also`."""

    @abstractmethod
    def _words(self) -> str:
        """Returns what follows "should be", without `also`."""

    def _names(self) -> tuple[str, ...]:
        """Returns the candidate names for "did you mean"."""
        return tuple(name for name in self.also if name is not None)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        schema = self._schema()
        if self.also:
            schema = core_schema.union_schema([core_schema.literal_schema([*self.also]), schema])
        also = ["null" if value is None else value for value in self.also]
        return core_schema.custom_error_schema(
            schema,
            custom_error_type=EXPECTED,
            custom_error_message=", or ".join([self._words(), *also]),
            custom_error_context={"names": ", ".join(self._names())},
        )


@dataclass(frozen=True)
class Whole(Expectation):
    """A whole number from `least` to `most`."""

    least: int
    most: int = LARGEST

    def _schema(self) -> CoreSchema:
        return core_schema.int_schema(ge=self.least, le=self.most, strict=True)

    def _words(self) -> str:
        if self.most < LARGEST:
            return f"a whole number from {self.least} to {self.most}"
        return "a positive whole number" if self.least == 1 else f"a whole number from {self.least}"


@dataclass(frozen=True)
class Number(Expectation):
    """A finite number within bounds; `above` is exclusive, `least` and `most` are inclusive."""

    above: float | None = None
    least: float | None = None
    most: float | None = None

    def _schema(self) -> CoreSchema:
        return core_schema.float_schema(
            gt=self.above, ge=self.least, le=self.most, strict=True, allow_inf_nan=False
        )

    def _words(self) -> str:
        if self.above is not None:
            most = "" if self.most is None else f" and up to {self.most:g}"
            return f"a number above {self.above:g}{most}"
        bounds = (("from", self.least), ("to", self.most))
        return "a number" + "".join(f" {w} {bound:g}" for w, bound in bounds if bound is not None)


@dataclass(frozen=True)
class Factor(Expectation):
    """A finite number other than 0."""

    def _schema(self) -> CoreSchema:
        number = core_schema.float_schema(strict=True, allow_inf_nan=False)
        return core_schema.no_info_after_validator_function(_not_zero, number)

    def _words(self) -> str:
        return "a number other than 0"


@dataclass(frozen=True)
class Flag(Expectation):
    """True or false."""

    def _schema(self) -> CoreSchema:
        return core_schema.bool_schema(strict=True)

    def _words(self) -> str:
        return "true or false"


@dataclass(frozen=True)
class Text(Expectation):
    """A non-empty text that `pattern` matches completely; `what` describes it."""

    what: str
    pattern: str | None = None

    def _schema(self) -> CoreSchema:
        return core_schema.str_schema(min_length=1, pattern=self.pattern, strict=True)

    def _words(self) -> str:
        return self.what


@dataclass(frozen=True)
class OneOf(Expectation):
    """One of some names."""

    choices: Sequence[str]

    def _schema(self) -> CoreSchema:
        return core_schema.literal_schema([*self.choices])

    def _words(self) -> str:
        return " or ".join(
            [", ".join(self.choices[:-1]), self.choices[-1]] if self.choices[1:] else self.choices
        )

    def _names(self) -> tuple[str, ...]:
        return (*self.choices, *super()._names())


@dataclass(frozen=True)
class ListOf(Expectation):
    """A list of distinct values; with `or_one`, also a single value without brackets."""

    each: Expectation
    least: int = 1
    or_one: bool = False

    def _schema(self) -> CoreSchema:
        each = self.each._schema()
        items = core_schema.list_schema(each, min_length=self.least, strict=True)
        different = core_schema.no_info_after_validator_function(_each_once, items)
        return core_schema.union_schema([each, different]) if self.or_one else different

    def _words(self) -> str:
        if self.or_one:
            return f"{self.each._words()}, or a list of different such values"
        many = "one or more different values" if self.least else "different values"
        return f"a list of {many}, each {self.each._words()}"

    def _names(self) -> tuple[str, ...]:
        return self.each._names()


def _not_zero(value: float) -> float:
    if value == 0:
        raise PydanticCustomError("zero", "is 0")
    return value


def _each_once(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise PydanticCustomError("repeated", "names one twice")
    return values


Count = Annotated[int, Whole(1)]
CountOrZero = Annotated[int, Whole(0)]
Seed = Annotated[int, Whole(0, 2**31 - 1)]
Positive = Annotated[float, Number(above=0)]
NotNegative = Annotated[float, Number(least=0)]
Share = Annotated[float, Number(least=0, most=1)]
PositiveShare = Annotated[float, Number(above=0, most=1)]
Switch = Annotated[bool, Flag()]
