"""Parse settings that are more than a number or a word, from text or TOML.

A ValueError continues the name of the setting ("must be ..."); a SettingsError is a sentence of its own.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping
from typing import Annotated, Literal

from pydantic import BeforeValidator, ByteSize, PlainSerializer, TypeAdapter, ValidationError

from spectralzoom.pipeline.errors import BudgetError
from spectralzoom.pipeline.planning.partial_scans import LineRun
from spectralzoom.pipeline.setting_fields import numbers_of, parse_text
from spectralzoom.pipeline.simulator.effects.probe import Tolerance
from spectralzoom.pipeline.simulator.render import BY_NAME
from spectralzoom.pipeline.simulator.scenes.laws import BUILT_IN_NAMES
from spectralzoom.pipeline.simulator.selection.choice import named_effects
from spectralzoom.pipeline.words import MOST_NAME, YEARS, is_field_name, is_scheduler, moment_of

BUILT_IN_SCENES = BUILT_IN_NAMES
RIG_FIELD = "field"  # scene in front of a rig or in a recording: only its size and bands are known
ALWAYS: Literal["always"] = "always"  # values of the setting `zoom`
NEVER: Literal["never"] = "never"
AUTO: Literal["auto"] = "auto"  # of the settings `zoom`, `source` and `prior`
SIM, RIG, RASTER, RECORDED = "sim", "rig", "raster", "recorded"  # of the setting `source`

LEAST_MEMORY = 256 * 1024**2
WHOLE, PART = "whole", "part"  # of the setting `extent`
KEEP_SIGNAL, KEEP_RAW = "signal", "raw"
_BYTES = TypeAdapter(ByteSize)
_DATE = re.compile(r"\d{1,4}([./-])\d{1,2}\1\d{1,4}(\s|$)|\d{4}-\d\d-\d\d(?!\d)")
_NUMBER_AND_UNIT = re.compile(r"\s*([-+0-9.e]+)\s*(nm|[uµμ]m|micro[a-z]*)?\s*")


def parse_name(value: object) -> str:
    """Return a name in any script, in Unicode's composed form; folders have its `run_stem`."""
    name = unicodedata.normalize("NFC", parse_text(value).strip())
    if not is_field_name(name):
        raise ValueError(
            f"must be a name of at most {MOST_NAME} characters with a letter or digit, without '/', line ends and "
            f"unseen characters, got {value!r}"
        )
    return name


def parse_visit(value: object) -> str:
    """Return the text of a visit, without spaces around it; a date at its begin has the form YYYY-MM-DD."""
    text = parse_text(value).strip()
    if _DATE.match(text) and moment_of(text) is None:
        raise ValueError(
            f"must be text, or begin with a date as YYYY-MM-DD from {YEARS[0]} to {YEARS[-1]}; got {value!r}"
        )
    return text


def parse_budget(value: object) -> float:
    """Return a fraction of the full scan's time, from 0.5 or text such as 50%; raises BudgetError."""
    number = _amount(value, {"%": 1.0, "": 1.0})
    if number is not None and str(value).strip().endswith("%"):
        number /= 100  # not times 0.01: 70% is 0.7
    if number is None or not 0 < number <= 1:
        raise BudgetError(f"must be a fraction of the full scan's seconds, above 0 and at most 1, got {value!r}")
    return number


def parse_compute(value: object) -> str:
    """Return a fraction of the multiply-adds of a full reading, such as 50%, or a number such as 4e9."""
    percent = _amount(value, {"%": 1.0})
    if percent is not None and 0 < percent <= 100:
        return f"{percent!r}%".replace(".0%", "%")
    number = None if str(value).strip().endswith("%") else _to_float(value)
    if number is None or number < 1:
        raise BudgetError(
            "must be a fraction of the multiply-adds of reading everything, above 0% and at most 100%, such as 50%, "
            f"or a number of them such as 4e9; got {value!r}"
        )
    return f"{number!r}"


def parse_memory(value: object) -> int:
    """Return bytes that suffice for one process, from a whole number or text such as 4GiB or 500 MB."""
    try:
        count = 0 if "%" in str(value) else int(_BYTES.validate_python(value))
    except ValidationError:
        count = 0
    if count <= 0:
        raise ValueError(f"must be a number with a unit such as 4GiB or 800MB, got {value!r}")
    if count < LEAST_MEMORY:
        raise ValueError(f"must be at least {LEAST_MEMORY // 2**20}MiB, got {value!r} ({count} bytes)")
    return count


def parse_scheduler(value: object) -> str:
    """Return threads, processes, or the address of a dask scheduler."""
    text = parse_text(value)
    if not is_scheduler(text):
        raise ValueError(
            "must be threads, processes, or the address of a dask scheduler such as tcp://192.168.1.5:8786; "
            f"got {text!r}"
        )
    return text


def parse_size(value: object) -> tuple[int, int]:
    """Return (width, height) [px], from text such as 1280x1024 or from two whole numbers."""
    parts = re.split("[x,]", value.lower()) if isinstance(value, str) else value
    sides = [to_whole(part) or 0 for part in parts] if isinstance(parts, list | tuple) else []
    if len(sides) != 2 or not all(1 <= side <= 100_000 for side in sides):
        raise ValueError(f"must be WIDTHxHEIGHT in px, such as 1280x1024, got {value!r}")
    return sides[0], sides[1]


def parse_effects(value: object) -> str:
    """Return ``auto``, ``all``, ``none`` or names of effects with commas, in the order of the chain."""
    names = value.split(",") if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"must be auto, all, none, or names of effects with commas; got {value!r}")
    words = [str(name).strip() for name in names if str(name).strip()]
    chosen = named_effects(",".join(words), list(BY_NAME))
    alone = words in (["auto"], ["all"], ["none"])
    return words[0] if alone or chosen is None else ",".join(name for name in BY_NAME if name in chosen)


def parse_tolerance(value: object) -> Tolerance:
    """Return a tolerance from noise sigmas (0.1) or DN (0.5dn); 0 omits nothing, inf has no limit."""
    found = re.fullmatch(r"([-+0-9.e]+|inf)\s*(dn|sigmas?)?", str(value).strip().lower())
    amount = None
    if found is not None and not isinstance(value, bool):
        amount = math.inf if found[1] == "inf" else _to_float(found[1])
    if found is None or amount is None or amount < 0:
        raise ValueError(
            f"must be 0 or more, in sigmas of the noise such as 0.1, or in DN such as 0.5dn, or inf; got {value!r}"
        )
    return Tolerance(amount, "dn" if found[2] == "dn" else "sigma")


def parse_bands(value: object) -> tuple[int, ...]:
    """Return band numbers counted from 0, each once, from a list or text with commas; 4-7 is a range."""
    bands = [to_whole(number) for item in _items(value) for number in numbers_of(item)]
    if not bands or any(band is None or band < 0 for band in bands):
        raise ValueError(f"must list band numbers counted from 0, such as 0,1,2 or 0-2; got {value!r}")
    if len(set(bands)) != len(bands):
        raise ValueError(f"names a band twice: {value!r}; name each once")
    return tuple(int(band or 0) for band in bands)


def parse_wavelengths(value: object) -> tuple[float, ...]:
    """Return wavelengths [nm] in the order of the bands, from a list or text with commas."""
    low, high = 150, 30_000
    waves = []
    for item in _items(value):
        wave = _to_float(item)
        if wave is None or not low <= wave <= high:
            found = _NUMBER_AND_UNIT.fullmatch(str(item).lower())
            nm = 0.0 if found is None else (_to_float(found[1]) or 0.0) * (1 if found[2] == "nm" else 1000)
            hint = f"; if it means {nm:g} nm, write {nm:g}" if low <= nm <= high else ""
            raise ValueError(f"must each be a number of nm from {low} to {high}, without a unit, got {item!r}{hint}")
        waves.append(wave)
    if not waves:
        raise ValueError(f"must list wavelengths in nm, such as 660,800; got {value!r}")
    return tuple(waves)


def parse_extent(value: object) -> str:
    """Return ``whole``, ``part``, or runs of lines such as 0:12-310,1:0-40."""
    word = str(value).strip().lower()
    return word if word in (WHOLE, PART) else format_extent(parse_extent_runs(word))


def parse_extent_runs(text: str) -> tuple[LineRun, ...]:
    """Return runs of lines: number of the sweep, first line, and the line after the last."""
    found = [re.fullmatch(r"(\d{1,6}):(\d{1,9})-(\d{1,9})", part.strip()) for part in text.split(",")]
    runs = [(int(one[1]), int(one[2]), int(one[3])) for one in found if one is not None]
    if len(runs) < len(found) or any(first >= stop for _, first, stop in runs):
        raise ValueError(
            "must be whole, part, or lines as in receipts, SWEEP:FIRST-STOP with commas such as 0:12-310,1:0-40;"
            f" got {text!r}"
        )
    return tuple(runs)


def format_extent(runs: Iterable[LineRun]) -> str:
    """Return runs of lines as text; see `parse_extent_runs`."""
    return ",".join(f"{sweep}:{first}-{stop}" for sweep, first, stop in runs)


def _items(value: object) -> list[object]:
    """Return the items of a list or tuple, the parts of text between commas, or the value itself."""
    if isinstance(value, str):
        return [part.strip() for part in value.split(",") if part.strip()]
    return list(value) if isinstance(value, list | tuple) else [value]


def _to_float(value: object) -> float | None:
    """Return a finite number, also from text; None for anything else, true and false included."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _amount(value: object, units: Mapping[str, float]) -> float | None:
    """Return a finite number times the factor of its unit; None for any other text or unit."""
    text = "" if isinstance(value, bool) else str(value).strip().lower()
    unit = next((one for one in units if one and text.endswith(one)), "")
    number = _to_float(text.removesuffix(unit))
    return None if number is None or unit not in units else number * units[unit]


def to_whole(value: object) -> int | None:
    """Return a whole number, also from text; None for anything else, 2.0 included."""
    if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d{1,20}\s*", value):
        return int(value)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


# each is read by its own parser; a form offers the type behind the parser
Name = Annotated[str, BeforeValidator(parse_name, str)]
VisitName = Annotated[str, BeforeValidator(parse_visit, str)]
Budget = Annotated[float, BeforeValidator(parse_budget, float | str)]
Compute = Annotated[str, BeforeValidator(parse_compute, str | float)]
Memory = Annotated[int, BeforeValidator(parse_memory, str | int)]
Scheduler = Annotated[str, BeforeValidator(parse_scheduler, str)]
Size = Annotated[tuple[int, int], BeforeValidator(parse_size, str | list[int])]
Effects = Annotated[str, BeforeValidator(parse_effects, str | list[str])]
Bands = Annotated[tuple[int, ...], BeforeValidator(parse_bands, str | list[int])]
Extent = Annotated[str, BeforeValidator(parse_extent, str)]
Wavelengths = Annotated[tuple[float, ...], BeforeValidator(parse_wavelengths, str | list[float])]
Limit = Annotated[Tolerance, BeforeValidator(parse_tolerance, str | float), PlainSerializer(str)]
