"""Every setting as `Settings` and its parts declare it: what it may be, in words, and a value of it, checked."""

from __future__ import annotations

import dataclasses
import math
import types
from datetime import datetime
from functools import cached_property
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import Field, PlainValidator, TypeAdapter, ValidationError

from flows.settings.survey_settings import Settings
from flows.settings.values import parse_moment, parse_text, to_whole, unit_guess
from pipeline.errors import BudgetError, SettingsError
from pipeline.stated import number_words, span_of


@dataclasses.dataclass(frozen=True)
class Declared:
    """One setting."""

    item: dataclasses.Field[Any]
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
            return number_words(low, high, self.told["unit"], endless=self.item.default == math.inf)
        words = {int: f"a whole number from {low} to {high}", bool: "true or false", str: "text that is not empty"}
        return words.get(self.kind, "")

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        known = {name: value for name, value in self.item.metadata.items() if value is not None}
        if self.kind is float:
            known["allow_inf_nan"] = self.item.default == math.inf
        kind: Any = Annotated[self.kind, PlainValidator(parse_text) if self.kind is str else Field(**known)]
        return TypeAdapter(kind)

    def _from_text(self, text: str) -> object:
        """The number or switch that a flag or a receipt says; what is none stays text."""
        if self.kind is int:
            return to_whole(text)
        if self.kind is bool:
            return {"true": True, "false": False}.get(text.lower(), text)
        try:
            return float(text) if self.kind is float else text
        except ValueError:
            return text

    def read(self, value: object, place: str) -> object:
        """Give the value, from text or TOML; SettingsError (of the budget BudgetError) with ``place`` otherwise."""
        if self.kind is str and value == self.item.default == "":
            return value
        try:
            return self._adapter.validate_python(
                self._from_text(value) if isinstance(value, str) else value, strict=True
            )
        except ValidationError as error:
            cause = error.errors()[0].get("ctx", {}).get("error")
        if isinstance(cause, ValueError):  # of its own parser
            joint = ": " if isinstance(cause, SettingsError) else " "
            raise (BudgetError if isinstance(cause, BudgetError) else SettingsError)(f"{place}{joint}{cause}")
        hint = unit_guess(value, *span_of(self.item), self.told["unit"]) if self.kind is float else ""
        why = f"; {self.told['why']}" if self.told["why"] else ""
        raise SettingsError(f"{place} must be {self.expected}{';' if self.choices else ','} got {value!r}{hint}{why}")


def _declared(make: type[Any]) -> dict[str, Declared]:
    own = {datetime: Annotated[datetime, PlainValidator(parse_moment)]}
    hints = get_type_hints(make, include_extras=True)
    found = {}
    for item in dataclasses.fields(make):
        hint = hints[item.name]
        if get_origin(hint) in (types.UnionType, Union):
            (hint,) = (part for part in get_args(hint) if part is not types.NoneType)
        found[item.name] = Declared(item, own.get(hint, hint))
    return found


SURVEY = _declared(Settings)  # a table by the dataclass that it stands for
TABLES = {
    name: _declared(one.kind)
    for name, one in SURVEY.items()
    if isinstance(one.kind, type) and dataclasses.is_dataclass(one.kind)
}
