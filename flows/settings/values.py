"""Settings that are more than a number or a word: from text or TOML to the value, or what is wrong, without its place.

A ValueError continues the setting's name ("must be ..."); a SettingsError is a sentence of its own.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated

from pydantic import ByteSize, PlainValidator, TypeAdapter, ValidationError

from pipeline.errors import BudgetError
from pipeline.planning.partial_scans import LineRun
from pipeline.planning.uniform_scans import MIOU
from pipeline.setting_fields import format_number, numbers_of
from pipeline.simulator.effects.probe import Unit
from pipeline.simulator.render import BY_NAME
from pipeline.simulator.selection.choice import named_effects
from storage.archive.staging import is_name
from storage.parallel.pool import WorkerPool

LEAST_MEMORY = 256 * 1024**2
_BYTES = TypeAdapter(ByteSize)
# unit of a setting -> other units in which people write it, with the factor that makes it right
_OTHER_UNITS: dict[str, tuple[tuple[str, float], ...]] = {
    "ms": (("seconds", 1e3), ("microseconds", 1e-3)),
    "s": (("milliseconds", 1e-3), ("minutes", 60.0)),
    "um": (("metres", 1e6), ("millimetres", 1e3), ("nanometres", 1e-3)),
    "mm": (("metres", 1e3), ("micrometres", 1e-3)),
    "nm": (("micrometres", 1e3), ("metres", 1e9)),
    "hz": (("kilohertz", 1e3),),
    "m": (("millimetres", 1e-3), ("kilometres", 1e3)),
    "deg": (("1e-7 degrees", 1e-7), ("millionths of a degree", 1e-6)),
    "urad": (("radians", 1e6), ("degrees", 17453.3)),
    "km": (("metres", 1e-3),),
}


@dataclass(frozen=True)
class Tolerance:
    """Greatest change of any number by effects that a simulation leaves out, in noise sigmas or in DN."""

    value: float = 0.1
    unit: Unit = "sigma"

    def __str__(self) -> str:
        return f"{self.value!r}" + ("" if self.unit == "sigma" else "dn")


def parse_text(value: object) -> str:
    """Text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be text that is not empty, got {value!r}")
    return value


def parse_name(value: object) -> str:
    """A name that a file can have too: of letters, digits, '_', '-' and '.'."""
    name = parse_text(value)
    if not is_name(name):
        raise ValueError(f"must be a name of letters, digits, '_', '-' and '.', got {value!r}")
    return name


_DATE = re.compile(r"\d{1,4}([./-])\d{1,2}\1\d{1,4}")


def parse_visit(value: object) -> str:
    """Words, or a date or moment as 2026-06-01; raises ValueError for a date in another form."""
    text = parse_text(value)
    first = text.split()[0]
    if _DATE.fullmatch(first):
        try:
            datetime.fromisoformat(first)
        except ValueError:
            raise ValueError(
                f"must be words, or a date as year-month-day (2026-06-01), by which days between visits are counted; "
                f"got {value!r}"
            ) from None
    return text


def parse_budget(value: object) -> float:
    """A fraction of the full scan's seconds above 0 and at most 1; raises BudgetError."""
    number = _to_float(value)
    if number is None or not 0 < number <= 1:
        percent = _to_float(value.removesuffix("%")) if isinstance(value, str) else number
        is_percent = percent is not None and 1 < percent <= 100
        hint = f"; for {percent:g} % write {percent / 100:g}" if is_percent and percent is not None else ""
        raise BudgetError(f"must be a fraction of the full scan's seconds, above 0 and at most 1, got {value!r}{hint}")
    return number


def parse_bytes(value: object) -> int:
    """Bytes above 0, from a whole number or text such as 4GiB or 500 MB."""
    try:
        count = 0 if "%" in str(value) else int(_BYTES.validate_python(value))
    except ValidationError:
        count = 0
    if count <= 0:
        raise ValueError(f"must be a number with a unit such as 4GiB or 800MB, got {value!r}")
    return count


def parse_compute(value: object) -> str:
    """A fraction of what reading everything takes, such as 25%, or a number of multiply-adds such as 4e9."""
    percent = _amount(value, {"%": 1.0})
    if percent is not None and 0 < percent <= 100:
        return f"{percent!r}%".replace(".0%", "%")
    number = None if isinstance(value, str) and value.strip().endswith("%") else _to_float(value)
    if number is None or not number >= 1:
        hint = f"; for {100 * number:g} % write {100 * number:g}%" if number is not None and 0 < number < 1 else ""
        raise BudgetError(
            "must be a fraction of the multiply-adds of reading everything, above 0% and at most 100%, such as 25%, "
            f"or a number of them such as 4e9; got {value!r}{hint}"
        )
    return f"{number!r}"


def limit_of(text: str | None, whole: float) -> float:
    """The number that a limit comes to: that fraction of the whole, or what it says itself; no end where it is None."""
    if text is None:
        return math.inf
    return float(text.removesuffix("%")) / 100 * whole if text.endswith("%") else float(text)


def parse_memory(value: object) -> int:
    """Bytes that a process can do with, as `parse_bytes` reads them."""
    count = parse_bytes(value)
    if count < LEAST_MEMORY:
        raise ValueError(f"must be at least {LEAST_MEMORY // 2**20}MiB, got {value!r} ({count} bytes)")
    return count


def parse_size(value: object) -> tuple[int, int]:
    """(width, height) in px, from text such as 1280x1024 or from two whole numbers."""
    parts = re.split("[x,]", value.lower()) if isinstance(value, str) else value
    sides = [to_whole(part) for part in parts] if isinstance(parts, list | tuple) else []
    if len(sides) != 2 or any(side is None or not 1 <= side <= 100_000 for side in sides):
        raise ValueError(f"must be WIDTHxHEIGHT in px, such as 1280x1024, got {value!r}")
    return int(sides[0] or 0), int(sides[1] or 0)


def parse_goals(value: object) -> dict[str, float]:
    """Least mIoU of a map, or IoU of a class, 0..1 by name: 92, weed=70, or both with commas, in percent."""
    goals: dict[str, float] = {}
    for item in _items(value):
        name, _, text = str(item).rpartition("=")
        percent = _to_float(text if isinstance(item, str) else item)
        if percent is None or not 0 < percent <= 100 or (name := name.strip() or MIOU) in goals:
            raise ValueError(
                "must be the least mIoU of the map in percent, above 0 and at most 100, or that of classes, each once: "
                f"92, weed=70 or 92,weed=70; got {value!r}"
            )
        goals[name] = percent / 100
    if not goals:
        raise ValueError(f"must be the least mIoU of the map in percent, such as 92, or weed=70; got {value!r}")
    return goals


def parse_goal(value: object) -> str:
    """Goals as one text; see `parse_goals`."""
    return ",".join(
        f"{100 * least:g}" if name == MIOU else f"{name}={100 * least:g}" for name, least in parse_goals(value).items()
    )


def parse_effects(value: object) -> str:
    """``auto``, ``all``, ``none`` or names of effects with commas between them, in the order of the chain."""
    names = value.split(",") if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"must be auto, all, none, or names of effects with commas; got {value!r}")
    words = [str(name).strip() for name in names if str(name).strip()]
    chosen = named_effects(",".join(words), list(BY_NAME))
    alone = words in (["auto"], ["all"], ["none"])
    return words[0] if alone or chosen is None else ",".join(name for name in BY_NAME if name in chosen)


def parse_moment(value: object) -> datetime:
    """A date and time with its zone, as TOML writes it; given in UTC."""
    moment = value
    if isinstance(value, str):
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            moment = None
    if not isinstance(moment, datetime):
        raise ValueError(f"must be a date and time with its zone, such as 2026-06-01T12:00:00+02:00; got {value}")
    if moment.tzinfo is None:
        zoned = moment.isoformat()
        raise ValueError(f"needs a time zone: write {zoned}Z for UTC, or {zoned}+02:00; got {value}")
    return moment.astimezone(UTC)


def parse_tolerance(value: object) -> Tolerance:
    """A number of noise sigmas, or text such as 0.5dn for DN; 0 leaves out nothing, inf all that can be."""
    found = re.fullmatch(r"([-+0-9.e]+|inf)\s*(dn|sigmas?)?", str(value).strip().lower())
    amount = None if found is None or isinstance(value, bool) else _to_float(found[1])
    if found is not None and found[1] == "inf":
        amount = math.inf
    if found is None or amount is None or amount < 0:
        raise ValueError(
            "must be 0 or more, in sigmas of the noise such as 0.1, or in DN such as 0.5dn; inf leaves out all that "
            f"can be; got {value!r}"
        )
    return Tolerance(amount, "dn" if found[2] == "dn" else "sigma")


def parse_bands(value: object) -> tuple[int, ...]:
    """Band numbers counted from 0, none of them twice; a list or text with commas, of which 4-7 is a run."""
    bands = [to_whole(number) for item in _items(value) for number in numbers_of(item)]
    if not bands or any(band is None or band < 0 for band in bands):
        raise ValueError(f"must list band numbers counted from 0, such as 0,1,2 or 0-2; got {value!r}")
    if len(set(bands)) != len(bands):
        raise ValueError(f"names a band twice: {value!r}; name each once")
    return tuple(int(band or 0) for band in bands)


def parse_wavelengths(value: object) -> tuple[float, ...]:
    """Wavelengths in nm, in the order of the bands; a list or text with commas."""
    low, high = 150, 30_000
    waves = [_to_float(item) for item in _items(value)]
    if not waves:
        raise ValueError(f"must list wavelengths in nm, such as 660,800; got {value!r}")
    for item, wave in zip(_items(value), waves, strict=True):
        if wave is None or not low <= wave <= high:
            raise ValueError(
                f"must each be {format_number(low, high, 'nm')}, got {item!r}{unit_guess(wave, low, high, 'nm')}"
            )
    return tuple(wave for wave in waves if wave is not None)


def _items(value: object) -> list[object]:
    """A list's items, the parts of text between commas, or the one number itself."""
    if isinstance(value, str):
        return [part.strip() for part in value.split(",") if part.strip()]
    return list(value) if isinstance(value, list | tuple) else [value]


def _to_float(value: object) -> float | None:
    """A finite number, also from text; None for anything else (true and false are no numbers)."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _amount(value: object, units: Mapping[str, float]) -> float | None:
    """A finite number by its unit, the text behind it; None of anything else, and of a unit that is none of these."""
    text = "" if isinstance(value, bool) else str(value).strip().lower()
    unit = next((one for one in units if one and text.endswith(one)), "")
    number = _to_float(text.removesuffix(unit))
    return None if number is None or unit not in units else number * units[unit]


def to_whole(value: object) -> int | None:
    """A whole number, also from text; None for anything else, 2.0 included."""
    if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d{1,20}\s*", value):
        return int(value)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def unit_guess(value: object, low: float, high: float, unit: str) -> str:
    """A guess at the unit in which a number out of range was written, as the end of a message."""
    number = _to_float(value)
    for name, factor in _OTHER_UNITS.get(unit.lower(), ()):
        if number is not None and low <= number * factor <= high:
            return f"; was it given in {name}? then write {number * factor:g}"
    return ""


def parse_scene(value: object) -> str:
    """Return the name of a scene or of its file."""
    if not isinstance(value, str) or not value:
        raise ValueError("must be the name of a scene or of its file")
    return value


EXTENT_WHOLE, EXTENT_PART = "whole", "part"


def parse_extent(value: object) -> str:
    """``whole``, ``part``, or runs of lines of the scan's sweeps, such as 0:12-310,1:0-40."""
    word = str(value).strip().lower()
    return word if word in (EXTENT_WHOLE, EXTENT_PART) else format_extent(parse_extent_runs(word))


def parse_extent_runs(text: str) -> tuple[LineRun, ...]:
    """Runs of lines, each the number of a sweep, its first line and the one after its last."""
    found = [re.fullmatch(r"(\d{1,6}):(\d{1,9})-(\d{1,9})", part.strip()) for part in text.split(",")]
    runs = [(int(one[1]), int(one[2]), int(one[3])) for one in found if one is not None]
    if len(runs) < len(found) or any(first >= stop for _, first, stop in runs):
        raise ValueError(
            "must be whole, part, or runs of lines as receipts tell them, SWEEP:FIRST-STOP with commas such as"
            f" 0:12-310,1:0-40; got {text!r}"
        )
    return tuple(runs)


def format_extent(runs: Iterable[LineRun]) -> str:
    """Runs of lines as one text; see `parse_extent_runs`."""
    return ",".join(f"{sweep}:{first}-{stop}" for sweep, first, stop in runs)


LEAST_REFRESH, MOST_REFRESH = 1 / 24, 3660.0  # days


def parse_refresh(value: object) -> float:
    """Days, from a number of them or text such as 14d, 36h or 2w."""
    days = _amount(value, {"h": 1 / 24, "d": 1.0, "w": 7.0, "": 1.0})
    if days is None or not LEAST_REFRESH <= days <= MOST_REFRESH:
        raise ValueError(f"must be a time of 1h to {MOST_REFRESH:g}d, such as 14d, 36h or 2w; got {value!r}")
    return days


KEEP_SIGNAL, KEEP_RAW = "signal", "raw"


def parse_keep(value: object) -> str:
    """``signal``, ``raw``, or ``raw`` and for how long: raw 7d."""
    word, _, age = str(value).strip().lower().partition(" ")
    if word in (KEEP_SIGNAL, KEEP_RAW) and not age:
        return word
    days = _amount(age, {"h": 1 / 24, "d": 1.0, "w": 7.0})
    if word != KEEP_RAW or days is None or not LEAST_REFRESH <= days <= MOST_REFRESH:
        raise ValueError(f"must be signal, raw, or raw and a time of 1h to {MOST_REFRESH:g}d: raw 7d; got {value!r}")
    return f"{KEEP_RAW} {age.strip()}"


def raw_days(keep: str) -> float:
    """Return for how many days raw lines stay: 0 without them, infinite where all stay."""
    word, _, age = keep.partition(" ")
    if word == KEEP_SIGNAL:
        return 0.0
    return _amount(age, {"h": 1 / 24, "d": 1.0, "w": 7.0}) or float("inf") if age else float("inf")


UNKNOWN_AUTO, UNKNOWN_OFF = "auto", "off"
LEAST_UNKNOWN, MOST_UNKNOWN = 0.05, 5.0  # percent


def parse_unknown(value: object) -> str:
    """``auto``, ``off``, or the fraction of known pixels that may be called unknown, such as 0.5%."""
    word = str(value).strip().lower()
    if word in (UNKNOWN_AUTO, UNKNOWN_OFF):
        return word
    percent = _amount(value, {"%": 1.0})
    if percent is None or not LEAST_UNKNOWN <= percent <= MOST_UNKNOWN:
        raise ValueError(
            f"must be auto, off, or the fraction of known pixels that may be called unknown, {LEAST_UNKNOWN:g}% to"
            f" {MOST_UNKNOWN:g}%, such as 0.5%; got {value!r}"
        )
    return f"{percent:g}%"


LEAST_EXPECTED_ERROR, MOST_EXPECTED_ERROR = 0.001, 0.5


def parse_expected_error(value: object) -> float:
    """Fraction of what is remembered, from a number or text such as 2%."""
    fraction = _amount(value, {"%": 0.01, "": 1.0})
    if fraction is None or not LEAST_EXPECTED_ERROR <= fraction <= MOST_EXPECTED_ERROR:
        raise ValueError(
            f"must be {LEAST_EXPECTED_ERROR:.1%} to {MOST_EXPECTED_ERROR:.0%} of what is remembered, such as 2%; got "
            f"{value!r}"
        )
    return fraction


Name = Annotated[str, PlainValidator(parse_name)]
VisitName = Annotated[str, PlainValidator(parse_visit)]
SceneName = Annotated[str, PlainValidator(parse_scene)]
Budget = Annotated[float, PlainValidator(parse_budget)]
Unknown = Annotated[str, PlainValidator(parse_unknown)]
Goal = Annotated[str, PlainValidator(parse_goal)]
Compute = Annotated[str, PlainValidator(parse_compute)]
Bytes = Annotated[int, PlainValidator(parse_bytes)]
Memory = Annotated[int, PlainValidator(parse_memory)]
Scheduler = Annotated[str, PlainValidator(lambda value: WorkerPool(parse_text(value)).scheduler)]
Size = Annotated[tuple[int, int], PlainValidator(parse_size)]
Effects = Annotated[str, PlainValidator(parse_effects)]
Bands = Annotated[tuple[int, ...], PlainValidator(parse_bands)]
Extent = Annotated[str, PlainValidator(parse_extent)]
Refresh = Annotated[float, PlainValidator(parse_refresh)]
Keep = Annotated[str, PlainValidator(parse_keep)]
ExpectedError = Annotated[float, PlainValidator(parse_expected_error)]
Wavelengths = Annotated[tuple[float, ...], PlainValidator(parse_wavelengths)]
