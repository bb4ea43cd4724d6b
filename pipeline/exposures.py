"""Read and compare the settings that the headers of cubes and reference frames state.

A camera's number is ``bias + gain * exposure * (dark current + light)``. White above its own dark frame is proportional
to gain times exposure, and is scaled by the stated ratio. A dark frame is not scaled: how much of it is bias, which
does not depend on the exposure, is not known.

Every other key that both headers have is compared if its values look like settings: numbers, or a word or two. Where
one that the numbers depend on differs, the frame is refused. Any other one is named in a note.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.envi_headers import finite_number
from spectralzoom.pipeline.errors import SceneError, list_some

SAME = 1e-3  # largest relative difference of equal exposures, which cameras round
MOST_DARK_ERROR = 0.05  # of white that the dark current of another exposure may stand for
MOST_NAMED = 24  # keys of a note
WILD_RATIO = 100.0  # of two exposures of one camera; units that are confused differ by a thousand
TO_MS = {"ns": 1e-6, "us": 1e-3, "ms": 1.0, "s": 1e3}
_WORDS = {"ns": "nanosec", "us": "µs μs usec microsec", "ms": "msec millisec", "s": "sec"}
_UNITS = {word: unit for unit, words in _WORDS.items() for word in (unit, *words.split())}
_UNITS |= {f"{word}ond{end}": _UNITS[word] for word in list(_UNITS) if word.endswith("sec") for end in ("", "s")}
_UNITS |= {"db": "dB", "decibel": "dB", "x": "x", "factor": "x"}
_OWN_UNIT = {"tint": "ms", "shutter": "ms"}  # of Specim and of Resonon, whose headers do not state it

_UNIT = rf"(?:\s*(?:in )?[(\[]\s*(?P<unit>\w+)\s*[)\]]| (?:in )?(?P<word>{'|'.join(_UNITS)})|(?P<end>ms|us|db))?"
_TIME = re.compile(
    r"(?:(?:camera|sensor|frame|line) )?(?P<name>exposure|integration|shutter|tint|t int|(?:exp|int)(?= ?time))"
    rf"s? ?(?:times?|period|duration|(?P<speed>speed))? ?(?P<detector>\d?){_UNIT}"
)
_GAIN = re.compile(r"(?:(?:camera|sensor|detector|analog|analogue|digital|em) )?gain ?(?P<detector>\d?)" + _UNIT)
_UNIT_KEY = re.compile(r"(?:units? of )?(?P<of>.+?) ?units?|units? of (?P<other>.+)")
_AREA = re.compile(r".*(?:(?:aoi|roi|window).*(?:left|top|offset|start)|\b[hv](?:img|roi)\d?\b).*")
_FIXED = re.compile(  # the numbers depend on it
    r"(?!data .*gain values).*(?:(?<!\ba)gain|bin(?:n(?:ed|ing)|s?\b)|accum|co ?add|\btdi\b|\biso\b).*"
)
_OF_FORMAT = re.compile(  # fields of the ENVI format that its reader applies, or that lay out the file
    "samples|lines|bands|interleave|(?:data|file|sensor) type|byte order|header offset|file compression|[xyz] start|bbl"
    "|(?:major|minor) frame offsets|default (?:bands|stretch)|z plot range|map info|reflectance scale factor|classes"
    "|data (?:ignore value|gain values|offset values)|wavelength|fwhm"
)
_OF_LIGHT = re.compile(r".*(?:shutter|lamp|light|illumin|\bled\b|\bcap\b|\blid\b).*")  # off for a dark frame
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_NUMBERS = rf"{_NUMBER}(?:[\s,;x*]+{_NUMBER}){{0,7}}"
_SETTING = re.compile(rf"{_NUMBERS} ?[a-zµ%°]{{0,8}}|(?=.{{1,24}}$)[a-z][a-z0-9+-]*(?: [a-z0-9][a-z0-9+-]*)?")
_VALUE = re.compile(
    r"(?:(?P<over>1) ?/ ?)?(?P<number>[-+]?[\d.]+(?:,\d+)?(?:e[-+]?\d+)?|[-+]?(?:nan|inf))\s*(?P<unit>[a-zµμ]*)"
)


@dataclass(frozen=True)
class Taken:
    """Exposure, gain and binning of a cube or frame; empty where nothing states them."""

    where: str = ""
    exposures: Mapping[str, float] = field(default_factory=dict)  # [ms], by the number of the detector
    times: Mapping[str, float] = field(default_factory=dict)  # exposures without a unit, by their key
    gains: Mapping[str, tuple[float, str]] = field(default_factory=dict)  # number and unit (dB, x or none), by key
    frame: Mapping[str, str] = field(default_factory=dict)  # settings that have to be equal, as texts, by key
    others: Mapping[str, str] = field(default_factory=dict)  # other keys that look like settings
    notes: tuple[str, ...] = ()
    conflicts: tuple[str, ...] = ()  # keys that contradict each other
    cut: bool = False  # bands of a larger frame were picked by their wavelengths, so that areas may differ

    @property
    def exposure_ms(self) -> float | None:
        """Return the exposure, of several detectors the longest; None if nothing states it with a unit."""
        return max(self.exposures.values(), default=None)

    @property
    def text(self) -> str:
        """Return the exposure and the gain for messages."""
        times = [f"{ms:g} ms" for ms in dict.fromkeys(self.exposures.values())]
        times = times or [f"{key} = {time:g} (no unit)" for key, time in self.times.items()]
        return " and ".join(times or ["an exposure that is not stated"]) + self.gains_text

    @property
    def gains_text(self) -> str:
        """Return the gains as the end of `text`."""
        return "".join(f", {key} = {self.settings[key]}" for key in self.gains)

    @property
    def settings(self) -> dict[str, str]:
        """Return gains and other settings as texts, by key."""
        return {key: f"{gain:g} {unit}".rstrip() for key, (gain, unit) in self.gains.items()} | dict(self.frame)


def taken_with(where: str, *headers: Mapping[str, object]) -> Taken:
    """Return what headers (fields, comments, attributes) of one file state; messages call it ``where``.

    Keys are those of several makes, with the unit in key, value or a key of its own; ``description`` may hold keys,
    too. An exposure that cannot be read is kept as a text, with a note.
    """
    every = [(key, str(value)) for header in headers for key, value in header.items()]
    about = "\n".join(value for key, value in every if key == "description")
    parts = (re.split("[=:]", part, maxsplit=1) for part in re.split(r"[\n;]|,(?=\s*[^\W\d][^,;=:\n]*[=:])", about))
    every += [(pair[0], pair[1]) for pair in parts if len(pair) == 2]
    named = [(re.sub(r"[\s_.,/]+", " ", key.lower()).strip(), value) for key, value in every]
    found = _Reader(where)
    for name, value in named:
        if (of := _UNIT_KEY.fullmatch(name)) is not None and (word := value.lower().strip(" []()")):
            found.units[of["of"] or of["other"]] = _UNITS.get(word, word)
    for name, value in named:
        if _UNIT_KEY.fullmatch(name) is None:
            found.add(name, value)
    exposures = {detector: ms for detector, (_, ms) in found.exposures.items()}
    times = {} if exposures else found.times
    texts = tuple(found.notes), tuple(found.conflicts)
    return Taken(where, exposures, times, found.gains, found.frame, found.others, *texts)


@dataclass
class _Reader:
    """The keys of one file, sorted by kind."""

    where: str
    units: dict[str, str] = field(default_factory=dict)  # of keys, by their names
    exposures: dict[str, tuple[str, float]] = field(default_factory=dict)
    times: dict[str, float] = field(default_factory=dict)
    gains: dict[str, tuple[float, str]] = field(default_factory=dict)
    frame: dict[str, str] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)

    def add(self, name: str, value: str) -> None:
        """Add a key, by its name in small letters with single spaces."""
        if (match := _GAIN.fullmatch(name)) is not None:
            number, unit = self._number(value, match)
            if number is None or unit not in ("dB", "x", "") or (unit == "x" and number <= 0):
                self._put(self.frame, name, _setting_text(value))
            else:
                self._put(self.gains, name[: match.end("detector")].strip(), (number, unit))
        elif (match := _TIME.fullmatch(name)) is not None:
            self._add_time(name, value, match)
        elif _FIXED.fullmatch(name) or _AREA.fullmatch(name):
            self._put(self.frame, name, _setting_text(value))
        elif _OF_FORMAT.fullmatch(name) is None and _SETTING.fullmatch(text := _setting_text(value)):
            self.others.setdefault(name, text)

    def _add_time(self, name: str, value: str, match: re.Match[str]) -> None:
        number, unit = self._number(value, match)
        unit = unit or _OWN_UNIT.get(match["name"] if match["speed"] is None else "", "")
        if number is None and not re.search(r"\d|nan|inf", value.lower()):
            return  # the state of a shutter
        if number is None or number <= 0 or unit not in ("" if match["speed"] is None else "s", *TO_MS):
            self._put(self.frame, name, f"{value.strip().lower()} {self._unit_of(match)}".strip())
            text = f"{name} = {value.strip()[:40]} is no exposure that can be read, and is left out"
            self.notes.append(f"{self.where}: {text}")
        elif not unit:
            self._put(self.times, name, number)
        else:
            ms = number * TO_MS[unit]
            other, known = self.exposures.setdefault(match["detector"], (name, ms))
            if not all_alike([ms, known]):
                self.conflicts.append(f"{other} of {known:g} ms and {name} of {ms:g} ms")

    def _put(self, table: dict[str, Any], name: str, value: Any) -> None:
        """Add an entry to a table; one that the table has with another value is a conflict."""
        if table.setdefault(name, value) != value:
            self.conflicts.append(f"{name} of {table[name]} and of {value}")

    def _unit_of(self, key: re.Match[str]) -> str:
        """Return the unit of a key that another key states, such as ``exposure units``; empty without one."""
        words = {word.removesuffix("s") for word in key[0].split()}
        name = str(key.groupdict().get("name", "gain")).strip()
        for of, unit in self.units.items():
            stated = {word.removesuffix("s") for word in of.split()}
            if stated <= words or name in stated:
                return unit
        return ""

    def _number(self, value: str, key: re.Match[str]) -> tuple[float | None, str]:
        """Return the number of a value, None if there is none, and its unit as in the value, the key or its own key."""
        match = _VALUE.fullmatch(value.strip().lower())
        if match is None:
            return None, ""
        of_key = key["unit"] or key["word"] or key["end"]
        units = {_UNITS.get(word, word) for word in (match["unit"], of_key, self._unit_of(key)) if word}
        number = finite_number(match["number"].replace(",", "."))
        if match["over"] is not None:  # 1/100, of seconds if no unit is stated
            number = 1 / number if number else None
            units = units or {"s"}
        return number, " and ".join(sorted(units))


def _setting_text(value: str) -> str:
    """Return a value as it is compared: numbers of a list, decimals to four digits, or text in small letters."""
    text = " ".join(value.lower().strip(" {}()[]\"'").split())
    if re.fullmatch(_NUMBERS, text) is None:
        return text
    return ", ".join(number if number.isdigit() else f"{float(number):.4g}" for number in re.findall(_NUMBER, text))


def all_alike(values: Iterable[float]) -> bool:
    """Return whether exposures or their ratios are equal but for the rounding of cameras."""
    found = list(values)
    return max(found) - min(found) <= SAME * max(found)


def span_text(exposure_ms: NDArray[np.float64]) -> str:
    """Return the exposures of lines as a text."""
    low, high = float(exposure_ms.min()), float(exposure_ms.max())
    return f"{low:g} ms" if all_alike([low, high]) else f"{low:g} to {high:g} ms"


def _exposure_at_gain(frame: Taken, cube: Taken, usual_ms: float, *, stated: bool) -> float | None:
    """Return the exposure [ms] of a frame at the gain of the cube; None if it is not known.

    Times without a unit count if both headers have the same key: the cube's is ``usual_ms``. Raises SceneError: they
    were taken with another binning, area or mode, gains or times differ without a unit, or detectors have different
    ratios.
    """
    for key in sorted(frame.settings.keys() & cube.settings.keys() - (frame.gains.keys() & cube.gains.keys())):
        if not (frame.cut and _AREA.fullmatch(key)):
            _check_same(frame, cube, key, frame.settings[key], cube.settings[key])
    gain = 1.0
    for key in sorted(frame.gains.keys() & cube.gains.keys()):
        (one, unit), (other, unit_of_cube) = frame.gains[key], cube.gains[key]
        if not unit or unit != unit_of_cube:
            texts = (f"{number:g} {word or '(no unit)'}" for number, word in (frame.gains[key], cube.gains[key]))
            _check_same(frame, cube, key, *texts)
        else:
            gain *= 10 ** ((one - other) / 20) if unit == "dB" else one / other
    both = sorted(frame.exposures.keys() & cube.exposures.keys())
    if both and not all_alike(frame.exposures[one] / cube.exposures[one] for one in both):
        times = (" and ".join(f"{taken.exposures[one]:g}" for one in both) + " ms" for taken in (frame, cube))
        _check_same(frame, cube, "exposures", *times)
    if frame.exposure_ms is not None and stated:
        return frame.exposure_ms * gain
    for key in sorted(frame.times.keys() & cube.times.keys()):
        return frame.times[key] / cube.times[key] * usual_ms * gain
    of_frame, of_cube = ([*taken.exposures.values(), *taken.times.values()] for taken in (frame, cube))
    of_cube = of_cube or [usual_ms] * stated
    if of_frame and of_cube and not all_alike([*of_frame, *of_cube]):
        key = next(iter({**frame.times, **cube.times}), "exposure")
        units = ("(no unit)" if taken.times else "ms" for taken in (frame, cube))
        texts = (f"{of[0]:g} {unit}" for of, unit in zip((of_frame, of_cube), units, strict=True))
        _check_same(frame, cube, key, *texts)
    return None if gain == 1 else usual_ms * gain


def _check_same(frame: Taken, cube: Taken, key: str, one: str, other: str) -> None:
    """Refuse a frame with another setting than the cube's (SceneError)."""
    if one != other:
        unit = ", or state the unit of both (ms, dB or x)" if "(no unit)" in one + other else ""
        both = f"{frame.where} was taken with {key} = {one}, {cube.where} with {other}"
        raise SceneError(f"{both}; give a frame taken with the cube's own settings{unit}")


def _compared_alone(dark: Taken, white: Taken, cube: Taken) -> list[str]:
    """Return a note on settings of both frames that the cube does not state (SceneError: the numbers depend on one)."""
    for key in sorted((dark.settings.keys() & white.settings.keys()) - cube.settings.keys()):
        _check_same(white, dark, key, white.settings[key], dark.settings[key])
    others = {key: one for key, one in dark.others.items() if key not in cube.others}
    return _differing(replace(dark, others=others), white, "dark")


def _differing(frame: Taken, cube: Taken, kind: str) -> list[str]:
    """Return a note on all other keys of both headers whose values look like settings and differ."""
    both = {key: (one, cube.others.get(key, one)) for key, one in frame.others.items()}
    unlit = [key for key in both if kind == "dark" and _OF_LIGHT.fullmatch(key)]
    texts = [f"{key} {one} and {other}" for key, (one, other) in both.items() if one != other and key not in unlit]
    what = f"{frame.where} and {cube.where} differ in {list_some(texts, MOST_NAMED)}"
    advice = "numbers are used as they are; if one of these changes them, give a frame of the same settings"
    return [f"{what}: {advice}"] if texts else []


def check_parts(one: Taken, first: Taken) -> None:
    """Refuse a part of a cube with another gain or binning than the first (SceneError)."""
    mine, other = ({**taken.gains, **taken.frame, **taken.times} for taken in (one, first))
    for key in mine | other:
        if mine.get(key) != other.get(key):
            both = f"{one.where} was taken with {key} = {mine.get(key)}, {first.where} with {other.get(key)}"
            raise SceneError(f"{both}; name these parts one by one")


def _alone(one: Taken, other: Taken) -> list[str]:
    """Return a note on the gains, modes and binning that one header states and the other does not."""
    keys = (
        key for key in one.settings if key not in other.settings and not (_TIME.fullmatch(key) or _AREA.fullmatch(key))
    )
    texts = ", ".join(f"{key} = {one.settings[key]}" for key in keys)
    return [f"{one.where} states {texts}, {other.where} does not: the same is assumed"] if texts and other.where else []


Frames = Mapping[str, tuple[NDArray[np.float32], Taken]]  # (sample, band) DN, by dark and white


def match_exposures(
    frames: Frames, cube: Taken, lines_ms: NDArray[np.float64], *, stated: bool, usual_ms: float | None = None
) -> tuple[float | None, list[str]]:
    """Return the exposure [ms] of the white frame at the gain of the cube, and notes; None if it is that of all lines.

    ``lines_ms`` (line,) are exposures of the lines, and ``stated`` is whether a file has them. A white frame that
    states no exposure is assumed to have ``usual_ms``, by default the median of the lines. A dark frame of another
    exposure is used as it is. Raises SceneError: a header contradicts itself, a frame has another binning or mode,
    another gain or exposure without a unit, or a dark frame of another exposure than the lines may change values by
    more than 5 %.
    """
    for taken in (cube, *(taken for _, taken in frames.values())):
        if taken.conflicts:
            raise SceneError(f"{taken.where} states {taken.conflicts[0]}; correct the header, or remove the wrong one")
    usual = float(np.median(lines_ms)) if usual_ms is None else usual_ms
    lines = span_text(lines_ms) + cube.gains_text if stated else cube.text
    notes = list(cube.notes)
    found: dict[str, float] = {}
    for kind in sorted(frames.keys() & {"dark", "white"}):
        frame = frames[kind][1]
        notes += [*frame.notes, *_alone(frame, cube), *_alone(cube, frame), *_differing(frame, cube, kind)]
        ms = _exposure_at_gain(frame, cube, usual, stated=stated)
        both = f"{frame.where} was taken with {frame.text}, the lines with {lines}"
        if ms is not None:
            found[kind] = ms
            if kind == "white" and max(float((lines_ms / ms).max()), float((ms / lines_ms).max())) >= WILD_RATIO:
                raise SceneError(f"{both}: they differ more than {WILD_RATIO:g} times; correct the number or its unit")
            scaled = kind == "white" and not all_alike([ms, *lines_ms])
            notes += [f"{both}: values are scaled by the ratio"] if scaled else []
        elif kind == "white" and stated and not all_alike([usual, *lines_ms]):
            found[kind] = usual
            notes.append(f"{both}: {usual:g} ms is assumed, and values are scaled by the ratio to each line")
        else:
            notes.append(f"{both}: the same exposure is assumed")
    if {"dark", "white"} <= frames.keys():
        notes += _compared_alone(frames["dark"][1], frames["white"][1], cube)
    white_ms = found.get("white")
    if "dark" in found and not all_alike([found["dark"], white_ms or usual, *lines_ms]):
        notes.append(_dark_note(frames, found["dark"], white_ms or usual, lines_ms, lines))
    return None if white_ms is None or all_alike([white_ms, *lines_ms]) else white_ms, notes


def _dark_note(frames: Frames, dark_ms: float, white_ms: float, lines_ms: NDArray[np.float64], lines: str) -> str:
    """Return a note on a dark frame of another exposure (SceneError: it may change values by more than 5 %).

    All of it may be dark current at most. Lines of another exposure then have another dark level, and so has white.
    """
    (dark, taken), (white, of_white) = frames["dark"], frames.get("white", (None, Taken()))
    what = f"{taken.where} was taken with {taken.text}, the lines with {lines}"
    kept = "it is used as it is, since its bias does not depend on the exposure"
    if white is None:
        return f"{what}: {kept}"
    lit = (white - dark)[white > dark]
    level = abs(float(np.nanmedian(dark))) / float(np.median(lit)) if lit.size else 0.0
    of_lines = np.abs(lines_ms / dark_ms - 1) * white_ms / lines_ms
    most = level * max(float(of_lines.max()), abs(white_ms / dark_ms - 1))
    what = f"{what}, and {of_white.where} with {of_white.text}"
    effect = f"values may be off by up to {most:.2g} of white, if all of it is dark current"
    if most > MOST_DARK_ERROR and not all_alike([dark_ms, *lines_ms]):
        raise SceneError(f"{what}: {effect}; give one of the exposure of the lines, or correct the header")
    return f"{what}: {kept}; {effect}"
