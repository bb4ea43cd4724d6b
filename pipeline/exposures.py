"""Read and compare the exposure, gain and binning of cubes and reference frames.

White above its own dark frame is proportional to the exposure, and is scaled by the stated ratio. A dark frame is not
scaled: how much of it is bias, which does not depend on the exposure, is not known. Gain and binning must be equal.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.envi_headers import finite_number
from spectralzoom.pipeline.errors import SceneError

SAME = 1e-3  # largest relative difference of equal exposures, which cameras round
MOST_DARK_ERROR = 0.05  # of white that the dark current of another exposure may stand for
_TO_MS = {
    **{"ns": 1e-6, "s": 1e3, "sec": 1e3, "second": 1e3},
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsec", "microsecond"), 1e-3),
    **dict.fromkeys(("ms", "msec", "millisec", "millisecond"), 1.0),
}
_OWN_UNIT = {"tint": "ms", "shutter": "ms"}  # of Specim and of Resonon, whose headers do not state it
_UNIT = rf"(?:\s*(?:in )?[(\[]\s*(?P<unit>\w+)\s*[)\]]| (?:in )?(?P<word>{'|'.join(_TO_MS)})s?)?"
_TIME = re.compile(
    r"(?:(?:camera|sensor|frame|line) )?(?P<name>exposure|integration|shutter|tint|t int|(?:exp|int)(?= ?time))"
    rf" ?(?:time|period|duration)? ?(?P<detector>\d?){_UNIT}"
)
_SETTING = re.compile(
    r"(?P<name>(?:\w+ )?gain(?: ?\d)?|(?:.* )?binning(?: ?\w+)?|aoi (?:left|top))(?: ?[(\[](?P<unit>\w+)[)\]])?"
)
_VALUE = re.compile(r"(?P<number>[-+]?[\d.]+(?:,\d+)?(?:e[-+]?\d+)?|[-+]?(?:nan|inf))\s*(?P<unit>[a-zµμ]*)")


@dataclass(frozen=True)
class Taken:
    """Exposure, gain and binning of a cube or frame; empty where nothing states them."""

    where: str = ""
    exposures: Mapping[str, float] = field(default_factory=dict)  # [ms], by the number of the detector
    times: Mapping[str, float] = field(default_factory=dict)  # exposures without a unit, by their key
    settings: Mapping[str, str] = field(default_factory=dict)  # gain, binning and first elements, by their key
    notes: tuple[str, ...] = ()
    conflicts: tuple[str, ...] = ()  # keys that contradict each other

    @property
    def exposure_ms(self) -> float | None:
        """Return the exposure, of several detectors the longest; None if nothing states it with a unit."""
        return max(self.exposures.values(), default=None)

    @property
    def text(self) -> str:
        """Return the exposure for messages."""
        times = [f"{ms:g} ms" for ms in dict.fromkeys(self.exposures.values())]
        times = times or [f"{key} = {time:g} (no unit)" for key, time in self.times.items()]
        return " and ".join(times or ["an exposure that is not stated"])


def taken_with(where: str, *headers: Mapping[str, object]) -> Taken:
    """Return what headers (fields, comments, attributes) of one file state; messages call it ``where``.

    Keys are those of several makes, with the unit in key or value; lines of ``description`` may be keys. Numbers that
    are no exposure are left out with a note.
    """
    exposures: dict[str, float] = {}
    times: dict[str, float] = {}
    settings: dict[str, str] = {}
    notes: list[str] = []
    conflicts: list[str] = []
    every = [(key, str(value)) for header in headers for key, value in header.items()]
    about = "\n".join(value for key, value in every if key == "description")
    for key, value in (*every, *re.findall(r"^\s*([^=:\n]+)[=:](.*)$", about, re.MULTILINE)):
        name = re.sub(r"[\s_.,/]+", " ", key.lower()).strip()
        if (match := _SETTING.fullmatch(name)) is not None:
            plain = ", ".join(word.strip() for word in value.lower().strip("{} ").split(","))
            plain = re.sub(r"\d+\.\d+", lambda found: f"{float(found[0]):g}", plain)
            conflicts += _put(settings, match["name"], f"{plain} {match['unit'] or ''}".strip())
        elif (match := _TIME.fullmatch(name)) is not None:
            number, units = _time(value, match)
            if number is None and not re.search(r"\d|nan|inf", value.lower()):
                continue  # the state of a shutter
            if number is None or number <= 0 or len(units) > 1 or units - set(_TO_MS):
                notes.append(f"{where}: {name} = {value.strip()[:40]} is no exposure that can be read, and is left out")
            elif not units:
                conflicts += _put(times, name, number)
            else:
                ms = number * _TO_MS[units.pop()]
                if not all_alike([ms, exposures.setdefault(match["detector"], ms)]):
                    conflicts.append(f"exposures of {exposures[match['detector']]:g} ms and of {ms:g} ms ({name})")
    return Taken(where, exposures, {} if exposures else times, settings, tuple(notes), tuple(conflicts))


def _put(table: dict[str, Any], name: str, value: Any) -> list[str]:
    """Add an entry to a table, and return a text if it has another one."""
    return [] if table.setdefault(name, value) == value else [f"{name} of {table[name]} and of {value}"]


def _time(value: str, key: re.Match[str]) -> tuple[float | None, set[str]]:
    """Return the number of a value, None if there is none, and its different units in value and key."""
    match = _VALUE.fullmatch(value.strip().lower())
    if match is None:
        return None, set()
    words = (match["unit"], key["unit"] or key["word"] or "")
    units = [word if word in _TO_MS else word.removesuffix("s") for word in words]
    own = {_OWN_UNIT[key["name"]]} if key["name"] in _OWN_UNIT and not any(units) else set()
    return finite_number(match["number"].replace(",", ".")), ({*units} - {""}) | own


def all_alike(values: Iterable[float]) -> bool:
    """Return whether exposures or their ratios are equal but for the rounding of cameras."""
    found = list(values)
    return max(found) - min(found) <= SAME * max(found)


def span_text(exposure_ms: NDArray[np.float64]) -> str:
    """Return the exposures of lines as a text."""
    low, high = float(exposure_ms.min()), float(exposure_ms.max())
    return f"{low:g} ms" if all_alike([low, high]) else f"{low:g} to {high:g} ms"


def _exposure_of(frame: Taken, cube: Taken, usual_ms: float, *, stated: bool) -> float | None:
    """Return the exposure [ms] of a frame; None if it is not known.

    Times without a unit count if both headers have the same key: the cube's is ``usual_ms``. Raises SceneError: they
    were taken with another gain, binning or area, or detectors have different ratios.
    """
    for key in sorted(frame.settings.keys() & cube.settings.keys()):
        _check_same(frame, cube, key, frame.settings[key], cube.settings[key])
    both = sorted(frame.exposures.keys() & cube.exposures.keys())
    if both and not all_alike(frame.exposures[one] / cube.exposures[one] for one in both):
        _check_same(frame, cube, "exposures", frame.text, cube.text)
    if frame.exposure_ms is not None and stated:
        return frame.exposure_ms
    shared = sorted(frame.times.keys() & cube.times.keys())
    return frame.times[shared[0]] / cube.times[shared[0]] * usual_ms if shared else None


def _check_same(frame: Taken, cube: Taken, key: str, one: str, other: str) -> None:
    """Refuse a frame with another setting than the cube's (SceneError)."""
    if one != other:
        both = f"{frame.where} was taken with {key} = {one}, {cube.where} with {other}"
        raise SceneError(f"{both}; give a frame taken with the cube's own settings")


def check_parts(one: Taken, first: Taken) -> None:
    """Refuse a part of a cube with another gain or binning than the first (SceneError)."""
    mine, other = ({**taken.settings, **taken.times} for taken in (one, first))
    for key in mine | other:
        if mine.get(key) != other.get(key):
            both = f"{one.where} was taken with {key} = {mine.get(key)}, {first.where} with {other.get(key)}"
            raise SceneError(f"{both}; name these parts one by one")


Frames = Mapping[str, tuple[NDArray[np.float32], Taken]]  # (sample, band) DN, by dark and white


def match_exposures(
    frames: Frames, cube: Taken, lines_ms: NDArray[np.float64], *, stated: bool, usual_ms: float | None = None
) -> tuple[float | None, list[str]]:
    """Return the exposure [ms] of the white frame and notes; None if it is that of all lines.

    ``lines_ms`` (line,) are exposures of the lines, and ``stated`` is whether a file has them. A white frame that
    states no exposure is assumed to have ``usual_ms``, by default the median of the lines. A dark frame of another
    exposure is used as it is. Raises SceneError: a header contradicts itself, a frame has another binning or gain, or a
    dark frame may change values by more than 5 %.
    """
    for taken in (cube, *(taken for _, taken in frames.values())):
        if taken.conflicts:
            raise SceneError(f"{taken.where} states {taken.conflicts[0]}; correct the header, or remove the wrong one")
    usual = float(np.median(lines_ms)) if usual_ms is None else usual_ms
    lines = span_text(lines_ms) if stated else cube.text
    notes = list(cube.notes)
    found: dict[str, float] = {}
    for kind in sorted(frames.keys() & {"dark", "white"}):
        frame = frames[kind][1]
        notes += frame.notes
        ms = _exposure_of(frame, cube, usual, stated=stated)
        both = f"{frame.where} was taken with {frame.text}, the lines with {lines}"
        if ms is not None:
            found[kind] = ms
            scaled = kind == "white" and not all_alike([ms, *lines_ms])
            notes += [f"{both}: values are scaled by the ratio"] if scaled else []
        elif kind == "white" and stated and not all_alike([usual, *lines_ms]):
            found[kind] = usual
            notes.append(f"{both}: {usual:g} ms is assumed")
        else:
            notes.append(f"{both}: the same exposure is assumed")
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
    if white is None or white.shape != dark.shape:
        return f"{what}: {kept}"
    lit = (white - dark)[white > dark]
    level = abs(float(np.nanmedian(dark))) / float(np.median(lit)) if lit.size else 0.0
    of_lines = np.abs(lines_ms / dark_ms - 1) * white_ms / lines_ms
    most = level * max(float(of_lines.max()), abs(white_ms / dark_ms - 1))
    what = f"{what}, and {of_white.where} with {of_white.text}"
    effect = f"values may be off by up to {most:.2g} of white, if all of it is dark current"
    if most > MOST_DARK_ERROR:
        raise SceneError(f"{what}: {effect}; give one of the exposure of the lines, or correct the header")
    return f"{what}: {kept}; {effect}"
