"""Declare settings where they are used: default, range, unit, meaning and source."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import Field, field, fields
from functools import partial
from typing import Any, Literal


def stated(
    default: Any,
    about: str,
    unit: str = "",
    ge: float | None = None,
    le: float | None = None,
    *,
    source: Literal["", "measured", "data sheet", "assumed"] = "",
    example: object = None,
) -> Any:
    """Return a dataclass field with the complete description of a setting.

    ``default`` is ``dataclasses.MISSING`` for a required setting. A number is finite, unless its default is infinite.
    ``about`` is one line of help, ``ge`` and ``le`` the least and greatest allowed value [unit]. ``source`` says where
    the default comes from: only "measured" ones were measured on a unit. Help shows ``example`` if there is no default,
    or if the default is written in another way.
    """
    known = {"description": about, "ge": ge, "le": le}  # names of pydantic's Field
    extra = {"unit": unit, "source": source, "example": example}
    return field(default=default, metadata={**known, "json_schema_extra": extra})


assumed = partial(stated, source="assumed")  # the default is not confirmed on a unit


def format_number(low: float, high: float, unit: str = "", *, endless: bool = False) -> str:
    """Return the allowed range of a number, for a message."""
    text = f"a number from {low:g} to {high:g}" if math.isfinite(high) else f"a number of at least {low:g}"
    return text + (f" {unit}" if unit else "") + (" or inf" if endless else "")


def span_of(item: Field[Any]) -> tuple[float, float]:
    """Return the least and greatest value of a number."""
    low, high = item.metadata.get("ge"), item.metadata.get("le")
    return (-math.inf if low is None else low), (math.inf if high is None else high)


def misfits(part: Any) -> Iterator[tuple[str, str]]:
    """Yield the numbers of a dataclass that are out of range or not finite: name and message."""
    for item in fields(part):
        value, (low, high) = getattr(part, item.name), span_of(item)
        if value is None or (low, high) == (-math.inf, math.inf):
            continue
        endless = item.default in (None, math.inf)
        if isinstance(value, bool) or not low <= value <= high or (math.isinf(value) and not endless):
            allowed = format_number(low, high, item.metadata["json_schema_extra"]["unit"], endless=endless)
            yield item.name, f"must be {allowed}, got {value!r}"


def numbers_of(item: object) -> Sequence[object]:
    """Return the numbers of one item of a list: ``4-7`` means four of them."""
    found = re.fullmatch(r"(\d{1,5})-(\d{1,5})", str(item).strip())
    return [item] if found is None or int(found[1]) > int(found[2]) else range(int(found[1]), int(found[2]) + 1)
