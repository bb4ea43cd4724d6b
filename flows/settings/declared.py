"""Every setting as `Settings` and its parts declare it: what it may be, in words, and a value of it, checked."""

from __future__ import annotations

import types
from dataclasses import Field, dataclass, fields, is_dataclass
from datetime import datetime
from functools import cached_property
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pydantic

from flows.settings.survey_settings import Settings
from flows.settings.values import parse_moment, unit_guess
from pipeline.errors import BudgetError, SettingsError
from pipeline.stated import number_words, span_of


@dataclass(frozen=True)
class Declared:
    """One setting."""

    item: Field[Any]
    kind: Any  # its type, None left out

    @property
    def told(self) -> dict[str, Any]:
        """Unit, source, example, and what a refusal adds."""
        told: dict[str, Any] = self.item.metadata["json_schema_extra"]
        return told

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that there are; none where it is no choice."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def listed(self) -> str:
        """Its choices in one line; some hold commas themselves."""
        return ("  " if any("," in word for word in self.choices) else ", ").join(self.choices)

    @property
    def expected(self) -> str:
        """What it may be, as the end of "must be"; '' where only its own parser knows."""
        if self.choices:
            return f"one of {self.listed}"
        low, high = span_of(self.item)
        if self.kind is float:
            return number_words(low, high, self.told["unit"], endless=self._endless)
        words = {int: f"a whole number from {low} to {high}", bool: "true or false", str: "text that is not empty"}
        return words.get(self.kind, "")

    @property
    def _endless(self) -> bool:
        return self.kind is float and self.item.default == float("inf")

    @cached_property
    def _adapter(self) -> pydantic.TypeAdapter[Any]:
        known = {name: value for name, value in self.item.metadata.items() if value is not None}
        if self.kind is float:
            known["allow_inf_nan"] = self._endless
        elif self.kind is str and self.item.default != "":
            known["pattern"] = r"\S"
        kind: Any = Annotated[self.kind, pydantic.Field(**known)]
        return pydantic.TypeAdapter(kind)

    def read(self, value: object, place: str) -> object:
        """Give the value, from text or TOML; SettingsError (of the budget BudgetError) with ``place`` otherwise."""
        given = {"true": True, "false": False}.get(str(value).lower(), value) if self.kind is bool else value
        try:
            if isinstance(given, str) and self.kind in (int, float):
                return self._adapter.validate_strings(given)
            return self._adapter.validate_python(given, strict=True)
        except pydantic.ValidationError as error:
            cause = error.errors()[0].get("ctx", {}).get("error")
        if isinstance(cause, ValueError):  # of its own parser
            joint = ": " if isinstance(cause, SettingsError) else " "
            raise (BudgetError if isinstance(cause, BudgetError) else SettingsError)(f"{place}{joint}{cause}")
        hint = unit_guess(value, *span_of(self.item), self.told["unit"]) if self.kind is float else ""
        why = f"; {self.told['why']}" if self.told["why"] else ""
        raise SettingsError(f"{place} must be {self.expected}{';' if self.choices else ','} got {value!r}{hint}{why}")


def _declared(make: type[Any]) -> dict[str, Declared]:
    """Every field of a dataclass."""
    hints = get_type_hints(make, include_extras=True)
    return {item.name: Declared(item, _kind(hints[item.name])) for item in fields(make)}


def _kind(hint: Any) -> Any:
    """The type without None; of a moment with its parser."""
    if get_origin(hint) in (types.UnionType, Union):
        (hint,) = (part for part in get_args(hint) if part is not types.NoneType)
    return Annotated[datetime, pydantic.PlainValidator(parse_moment)] if hint is datetime else hint


SURVEY = _declared(Settings)  # a table by the dataclass that it stands for
TABLES = {
    name: _declared(one.kind) for name, one in SURVEY.items() if isinstance(one.kind, type) and is_dataclass(one.kind)
}
