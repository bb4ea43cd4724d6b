"""Declare settings where they are used: type, default, range, unit, help and source of the default.

A field of a table without `stated` is a parameter of a model, and no setting.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import partial
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.fields import FieldInfo

from spectralzoom.pipeline.toml_files import as_toml

Table = TypeVar("Table")
REQUIRED: Any = ...  # default of a setting that has none


def _as_form(schema: dict[str, Any]) -> None:
    """Complete the schema of a table for forms and documents, without parameters of models. Changes the schema.

    A form would send null and defaults over those of a settings file: the default is in the description, and ``usual``
    of the schema. ``about`` is the help with unit and source, ``shown`` the default or the example as TOML. What may
    only stand in a file is ``hidden``.
    """
    shown = {name: one for name, one in schema["properties"].items() if "description" in one}
    schema["hidden"] = {name: one for name, one in shown.items() if one.get("writeOnly")}
    schema["properties"] = {name: one for name, one in shown.items() if name not in schema["hidden"]}
    for name, one in shown.items():
        kinds = [kind for kind in one.pop("anyOf", ()) if kind.get("type") != "null"]
        one |= {"anyOf": kinds} if len(kinds) > 1 else dict(*kinds)
        one["title"] = name.replace("_", " ")
        usual = one.pop("default", REQUIRED)
        if "group" not in one:
            continue
        one["shown"] = as_toml(usual if one["example"] is None else one["example"])
        one["about"] = " ".join(one["description"].split()) + (f" [{one['unit']}]" if one["unit"] else "")
        one["about"] += f"; {one['source']}" if one["source"] else ""
        one["description"] = one["about"] + ("" if usual in (None, "", REQUIRED) else f"; default: {one['shown']}")
        if usual is not REQUIRED:
            one["usual"] = str(usual) if usual == math.inf else usual


CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra=_as_form)


def stated(
    default: Any,
    about: str | None = None,
    unit: str = "",
    ge: float | None = None,
    le: float | None = None,
    *,
    source: Literal["", "measured", "data sheet", "assumed"] = "",
    example: object = None,
    group: str = "",
    **more: Any,
) -> Any:
    """Return a field with the complete description of a setting.

    A number is finite, unless its default is infinite. ``about`` is the help; without it, the docstring below the field
    is. ``ge`` and ``le`` are the least and greatest allowed value [unit]. ``source`` says where the default comes from:
    only "measured" ones were measured on a unit. Help shows ``example`` if there is no default, or if the default is
    written in another way. Settings of a ``group`` are on the first page of the help. ``more`` are options of
    pydantic's Field.
    """
    extra: dict[str, Any] = {"unit": unit, "source": source, "example": example, "group": group}
    if more.get("exclude"):  # of receipts, and thus of forms
        extra["writeOnly"] = True
    if isinstance(default, float) and math.isinf(default):
        more["allow_inf_nan"] = True
    return Field(default, description=about, ge=ge, le=le, json_schema_extra=extra, **more)


assumed = partial(stated, source="assumed")  # the default is not confirmed on a unit


@dataclass_transform(frozen_default=True)
def settings_table(make: type[Table]) -> type[Table]:
    """Turn a class into a table of settings: a frozen dataclass.

    Values are checked where settings are read. A program may give others, such as the camera of a recording with fewer
    samples than a setting allows.
    """
    for name, kind in make.__annotations__.items():
        about = make.__dict__.get(name)
        if isinstance(about, FieldInfo):
            make.__annotations__[name] = Annotated[kind, about]
            if about.is_required():
                delattr(make, name)
            else:
                setattr(make, name, about.default)
    make.__pydantic_config__ = CONFIG  # type: ignore[attr-defined]
    return dataclass(frozen=True)(make)


def parse_text(value: object) -> str:
    """Return text that is not empty."""
    if isinstance(value, date):  # of a TOML file
        return value.isoformat()
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be text that is not empty, got {value!r}")
    if "\0" in value:
        raise ValueError(f"must be text without a null character, got {value!r}")
    return value


def parse_moment(value: object) -> datetime:
    """Return a date and time in UTC, from one with its time zone as TOML writes it."""
    moment = value
    if isinstance(value, str):
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            moment = None
    if not isinstance(moment, datetime):
        raise ValueError(f"must be a date and time with its zone, such as 2026-06-01T12:00:00+02:00; got {value}")
    if moment.tzinfo is None:
        raise ValueError(f"needs a time zone: write {moment.isoformat()}Z for UTC; got {value}")
    return moment.astimezone(UTC)


Text = Annotated[str, BeforeValidator(parse_text)]
Moment = Annotated[datetime, BeforeValidator(parse_moment, json_schema_input_type=str)]


def numbers_of(item: object) -> Sequence[object]:
    """Return the numbers of one item of a list: ``4-7`` means four of them."""
    found = re.fullmatch(r"(\d{1,5})-(\d{1,5})", str(item).strip())
    return [item] if found is None or int(found[1]) > int(found[2]) else range(int(found[1]), int(found[2]) + 1)
