"""Settings of what the simulated rig is like: for every field of its dataclasses a parser, made from the field itself.

Range and unit of a number stand in its field's metadata (`pipeline.simulator.rig_model`); nothing is listed twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import Field, fields
from datetime import UTC, datetime
from typing import Any, Literal, get_args, get_origin, get_type_hints

from flows.settings.values import Span, parse_choice, parse_number, parse_switch, parse_whole
from pipeline.errors import SettingsError

LEAST_DISTANCE_M = 1e-3
LARGEST_UNIT = 2**31 - 1

Parser = Callable[[object, str], object]


def field_parsers(make: type[Any]) -> dict[str, Parser]:
    """Give the parser of every field of one part of the rig."""
    kinds = get_type_hints(make)
    return {item.name: _parser(item, kinds[item.name]) for item in fields(make)}


def _parser(item: Field[Any], kind: Any) -> Parser:
    about = item.metadata
    if "least" in about:
        endless = item.default == math.inf
        return parse_number(Span(about["least"], about["most"], about["unit"], endless=endless))
    if kind is bool:
        return parse_switch
    if kind is int:
        return parse_whole(0, LARGEST_UNIT)
    if get_origin(kind) is Literal:
        return parse_choice(get_args(kind))
    if datetime in get_args(kind):
        return parse_moment
    return parse_number(Span(LEAST_DISTANCE_M, math.inf, item.name.rpartition("_")[2]))


def parse_moment(value: object, place: str) -> datetime:
    """A date and time with its zone, as TOML writes it; given in UTC."""
    moment = value
    if isinstance(value, str):
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            moment = None
    if not isinstance(moment, datetime):
        raise SettingsError(
            f"{place} must be a date and time with its zone, such as 2026-06-01T12:00:00+02:00; got {value}"
        )
    if moment.tzinfo is None:
        zoned = moment.isoformat()
        raise SettingsError(f"{place} needs a time zone: write {zoned}Z for UTC, or {zoned}+02:00; got {value}")
    return moment.astimezone(UTC)
