"""Read wavelengths, widths, colours and bad bands from the numbers, tags and band names of any file.

No file is opened here. A fact that cannot be read without a guess is left out, and a note gives the reason.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

RANGE_NM = (200.0, 3000.0)
THERMAL_NM = 20_000.0  # end of the longest wavelengths in cameras' files
LEAST_WIDTH_NM = 0.02
NEAR_INFRARED_NM = 800.0
YEARS = (1900, 2100)
# spelling of a unit: its length [nm]; the first ones may stand behind a number in the name of a band
_LENGTHS: Mapping[str, float] = {
    r"nm|nano ?-?met(?:er|re)s?": 1.0,
    r"[uμ]m|microns?|micro ?-?met(?:er|re)s?": 1000.0,
    r"å|[aå]ngstr(?:o|ö|oe)ms?": 0.1,
    r"m|met(?:er|re)s?": 1e9,
}
_BY_SIZE = {"nm": 1.0, "micrometres": 1000.0, "metres": 1e9}
_UNSAID = ("", "unknown", "none", "unspecified", "-", "1")
_MISSING = ("", "nan", "n/a", "na", "none", "null", "-", "--", "?", "unknown", "missing")
_NUMBER = r"(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:e[+-]?\d+)?"
_BRACKET = re.compile(r"(?:\b[a-z]\w*(?:\.\w+)?)?[\[({]|[\])}]", re.IGNORECASE)  # also of np.float64(450.0)
_KEY_UNIT = r"(?:in)?(nm|um|μm|nanomet(?:er|re)s?|micromet(?:er|re)s?|microns?|angstroms?)?"
CENTRES = re.compile(
    rf"(?:(?:band|cent(?:er|re)|central|peak|nominal|mean|radiation)*wavelengths?(?:cent(?:er|re)|value|list|d)?s?"
    rf"|(?:band|spectral)cent(?:er|re)s?|wls?|lambdas?|(?=nm)){_KEY_UNIT}"
)
WIDTHS = re.compile(
    rf"(?:(?:band|wavelength)?fwhms?|fullwidth(?:at)?halfmax(?:imum)?|bandwidths?|spectralwidths?){_KEY_UNIT}"
)
GOOD_BANDS = ("bbl", "good", "goodband", "goodbands", "goodwavelength", "goodwavelengths", "goodbandlist")  # 0 is bad

MOST_NAME = 200  # characters of a band name that are read
_COUNTED = r"(?<![a-z\d])(?:bands?|b|channels?|chan|ch|layers?|lyr|nr|no)[\s_#.:]*"  # words before a band's number
_BAND_NUMBER = re.compile(rf"({_COUNTED}|^\W*)(\d+)(?![.,]?\d)")
_LENGTH = re.compile(rf"(?<![\d.,])({_NUMBER})\s*({'|'.join(list(_LENGTHS)[:3])})(?![a-z])")
_BARE = re.compile(r"(?<![\d.])(?:\d{3,4}|\d?\.\d+)(?!\d)")  # may be a length in nm or um
# words of a colour: its usual wavelength [nm]; the first that fits counts
_COLOURS: Mapping[str, float] = {
    "coastal(?: aerosol| blue)?|aerosol": 443.0,
    "red ?edge ?(?:1|071)": 705.0,
    "red ?edge ?(?:2|075)": 740.0,
    "red ?edge ?(?:3|078)": 783.0,
    "red ?edge": 717.0,
    "near ?(?:infra ?red|ir)|nir": NEAR_INFRARED_NM,
    "infra ?red": np.nan,  # short, middle or thermal
    "swir ?(?:16|1)": 1610.0,
    "swir ?(?:22|2)": 2200.0,
    "blue": 460.0,
    "green": 550.0,
    "yellow": 590.0,
    "orange": 620.0,
    "red": 640.0,
    "gr[ae]y|pan(?:chromatic)?": 550.0,
}
_LETTERS = {"r": "red", "g": "green", "b": "blue", "n": "nir"}
_COLOUR = re.compile("|".join(f"(?<![a-z])({words})(?![a-z])" for words in _COLOURS))
_PLAIN = re.compile(
    rf"(?:(?:{'|'.join(_COLOURS)}|r|x|wl|w|λ|lambda|wavelength|refl|reflectance|rho|rrs|radiance)[\s_-]*)*({_NUMBER})"
)


@dataclass(frozen=True)
class Bands:
    """Facts of the bands; None if not known."""

    wavelength_nm: NDArray[np.float64] | None = None  # (band,), NaN of a band without one
    fwhm_nm: NDArray[np.float64] | None = None  # (band,)
    origin: str = ""  # one sentence
    notes: tuple[str, ...] = ()  # assumptions, or reasons why nothing is known

    @property
    def unknown(self) -> tuple[int, ...]:
        """Return the bands (from 0) without a wavelength where others have one."""
        return () if self.wavelength_nm is None else tuple(np.flatnonzero(np.isnan(self.wavelength_nm)).tolist())


def why_unknown(bands: Bands) -> str:
    """Return why there are no wavelengths, with every reason that was found."""
    reasons = "; ".join(bands.notes)
    return f"their wavelengths cannot be read ({reasons})" if reasons else "nothing says their wavelengths"


# --- numbers and their unit -------------------------------------------------------------------------------------------


def scale_nm(unit: object) -> float | None:
    """Return the nm of a unit of length; None for other and unknown units."""
    text = _plain_text(unit).strip(" .[](){}'\"")
    return next((nm for words, nm in _LENGTHS.items() if re.fullmatch(words, text)), None)


def is_spectral(attrs: Mapping[str, Any]) -> bool:
    """Return whether attributes are those of wavelengths, by their standard name or a unit of nm, um or Angstrom."""
    short = scale_nm(attrs.get("units", attrs.get("unit")))
    return "wavelength" in str(attrs.get("standard_name", "")) or (short is not None and short <= 1000)


def bands_of_numbers(
    values: object, unit: object, origin: str, widths: object = None, width_unit: object = None
) -> Bands:
    """Return bands by numbers (band,) in a unit; numbers that are not above 0 are missing.

    Without a unit they are nm, micrometres or metres by their size, with a note. Widths without a unit have that of
    the wavelengths. Numbers in a unit that is no length, or with most of them missing, give a note alone.
    """
    centres = _above_zero(values)
    known = np.isfinite(centres)
    if 2 * known.sum() < max(len(centres), 1):
        return Bands(notes=(f"the wavelengths are left out: {known.sum()} of {len(centres)} bands have one",))
    scale, doubt = _scale(unit, centres[known])
    if scale is None:
        return Bands(notes=(f"the wavelengths are left out: {doubt}",))
    notes = [doubt] if doubt else []
    if not known.all():
        notes.append(f"the file gives no wavelength of bands {bands_text(np.flatnonzero(~known).tolist())} (from 0)")
    if widths is None:
        return Bands(centres * scale, None, origin, tuple(notes))
    fwhm = _above_zero(widths) * (scale if _plain_text(width_unit) in _UNSAID else scale_nm(width_unit) or np.nan)
    fits = fwhm.shape == centres.shape and bool(((fwhm >= LEAST_WIDTH_NM) & (fwhm < centres * scale))[known].all())
    notes += [] if fits else ["the widths (fwhm) are left out: not every band has one that fits its wavelength"]
    return Bands(centres * scale, fwhm if fits else None, origin, tuple(notes))


def _above_zero(values: object) -> NDArray[np.float64]:
    """Return a flat copy, NaN where a number is masked, infinite or not above 0."""
    numbers = np.ma.filled(np.ma.array(values, np.float64), np.nan).ravel()
    return np.where(np.isfinite(numbers) & (numbers > 0), numbers, np.nan)


def _scale(unit: object, numbers: NDArray[np.float64]) -> tuple[float | None, str]:
    """Return the nm of a unit, and a note; a unit that is not stated is that of usual wavelengths of this size."""
    if (known := scale_nm(unit)) is not None:
        return known, ""
    if _plain_text(unit) not in _UNSAID:
        return None, f"their unit {unit!r} is no length; expected nm, um, Angstrom or m"
    low, high = numbers.min(), numbers.max()
    if high <= 20 and (numbers % 1 == 0).all():
        return None, f"they have no unit, and {low:g} to {high:g} may count the bands"
    for name, scale in _BY_SIZE.items():
        if RANGE_NM[0] <= low * scale <= RANGE_NM[1] and high * scale <= THERMAL_NM:
            return scale, f"the wavelengths have no unit, read as {name} by their size"
    return None, f"they have no unit, and {low:g} to {high:g} fit no unit of wavelengths"


def are_wavelengths(numbers: NDArray[np.float64]) -> bool:
    """Return whether numbers without a unit can only be nm: no years, and not counted one by one."""
    if not ((numbers >= RANGE_NM[0]) & (numbers <= RANGE_NM[1])).all() or len(set(numbers)) < len(numbers):
        return False
    years = (numbers % 1 == 0) & (numbers >= YEARS[0]) & (numbers <= YEARS[1])
    return not years.all() and not (len(numbers) > 1 and (np.diff(numbers) == 1).all())


# --- fields of a file -------------------------------------------------------------------------------------------------


def split_list(text: str, count: int) -> list[str] | None:
    """Return the ``count`` numbers of a list as texts; None if it is no such list.

    They are separated by semicolons, commas or spaces, and may be missing, or have decimal commas between semicolons.
    """
    bare = _BRACKET.sub(" ", text).strip()
    for between in (";",) if ";" in bare else (",", r"[,\s]+") if bare else ():
        words = [word.strip() for word in re.split(between, bare)]
        words = words[:-1] if len(words) == count + 1 and not words[-1] else words
        if len(words) == count and all(map(_is_number, words)):
            return words
    return None


def numbers_of_list(text: str, count: int) -> NDArray[np.float64] | None:
    """Return the (``count``,) numbers of a list, NaN where one is missing; None if it is no such list."""
    words = split_list(text, count)
    return None if words is None else np.array([_to_number(word) for word in words], np.float64)


def _words(value: object) -> list[Any]:
    """Return the items of a list in one text, with any separators, or of an array."""
    if isinstance(value, str):
        return re.findall(r"[^,;\s]+", _BRACKET.sub(" ", value))
    return list(np.asarray(value).ravel().tolist())


def _is_number(word: object) -> bool:
    """Return whether an item of a list is a number, or a word for a missing one."""
    return _plain_text(word) in _MISSING or re.fullmatch(rf"[+-]?{_NUMBER}", _plain_text(word)) is not None


def _to_number(text: object) -> float:
    """Return the number at the beginning of a text, with a point or a comma; NaN without one."""
    found = re.match(rf"[+-]?{_NUMBER}", _plain_text(text))
    return np.nan if found is None else float(found[0].replace(",", "."))


def _plain_text(text: object) -> str:
    """Return text of one line in lower case, with one sign for each of micro and Angstrom."""
    return " ".join(unicodedata.normalize("NFKC", "" if text is None else str(text)).lower().split())


def letters(key: str) -> str:
    """Return the small letters of a key alone, as they are compared: ``Band centres (µm)`` is ``bandcentresμm``."""
    return re.sub(r"[^a-zμ]+", "", _plain_text(key))


def bands_of_fields(
    fields: Mapping[str, object], names: Sequence[str | None], where: str, colours: Sequence[str] = ()
) -> Bands:
    """Return (band,) facts by a file's fields, else by the names of its bands, else by its colours; with all notes.

    A field such as ``wavelength`` or ``band centres (um)`` is a list in one text, or has one text or number a band.
    ``colours`` are GDAL's colour interpretations.
    """
    count = len(names)
    listed = bands_of_lists(fields, count, where)
    if listed.wavelength_nm is not None:
        return listed
    notes = listed.notes
    names = names if any(names) else _listed_names(fields, count)
    found = bands_of_names(names, where, () if notes else colours)
    return replace(found, notes=(*notes, *found.notes))


def bands_of_lists(fields: Mapping[str, object], count: int, where: str) -> Bands:
    """Return (band,) facts by lists in a file's fields, else notes alone."""
    notes: list[str] = []
    for key, numbers, unit in _lists(fields, CENTRES, count, notes):
        _, *widths = next(_lists(fields, WIDTHS, count, notes), ("",))
        found = bands_of_numbers(numbers, unit, f"wavelengths from the list {key} of {where}", *widths)
        notes += found.notes
        if found.wavelength_nm is not None:
            return replace(found, notes=tuple(notes))
    return Bands(notes=tuple(notes))


def _listed_names(fields: Mapping[str, object], count: int) -> Sequence[str | None]:
    """Return the names that a field lists, one a band; None each without such a list."""
    for key, value in fields.items():
        if letters(key) in ("bandname", "bandnames", "longname"):
            words = value.split(",") if isinstance(value, str) else _words(value)
            if len(words) == count:
                return list(map(str, words))
    return [None] * count


def _lists(
    fields: Mapping[str, object], kind: re.Pattern[str], count: int, notes: list[str]
) -> Iterator[tuple[str, NDArray[np.float64], object]]:
    """Yield key, (band,) numbers and unit of each list of a kind; ``notes`` say why others are left out."""
    units = {letters(key).removesuffix("s"): value for key, value in fields.items() if "unit" in key.lower()}
    of_kind = [value for key, value in units.items() if kind.fullmatch(key.removesuffix("unit"))]
    for key in sorted(fields, key=len):
        if (known := kind.fullmatch(letters(key))) is None:
            continue
        value, unit = fields[key], units.get(f"{letters(key)}unit", of_kind[0] if of_kind else "")
        words = (split_list(value, count) if isinstance(value, str) else None) or _words(value)
        wrong = [word for word in words if not _is_number(word)]
        several = set() if isinstance(unit, str) else {str(one) for one in _words(unit)}
        if wrong or len(words) != count or len(several) > 1:
            why = f"{str(wrong[0])!r} is no number" if wrong else f"{len(words)} for {count} bands"
            notes.append(f"{key} is left out: {'it has several units' if len(several) > 1 else why}")
            continue
        yield key, np.array([_to_number(word) for word in words]), known[1] or "".join(several) or unit


def bad_bands(fields: Mapping[str, object], count: int) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the bands (from 0) that a file's fields mark as bad, such as ``bbl``, and notes.

    A field is a list in one text, or has one text or number a band, "" where a band has none.
    """
    bad: set[int] = set()
    notes: list[str] = []
    for name, value in fields.items():
        if letters(name) in GOOD_BANDS:
            flags = [float(word) if isinstance(word, bool) else _to_number(word) for word in _words(value)]
            if len(flags) == count:
                bad |= {band for band, flag in enumerate(flags) if flag == 0}
            else:
                notes.append(f"{name} is left out: {len(flags)} flags for {count} bands")
        elif re.fullmatch("badbands?(?:list|multiplier)?s?", letters(name)):
            notes.append(f"{name} is not read: 1 may mean good or bad there; name the good bands in a scene.toml")
    return tuple(sorted(bad)), tuple(notes)


def bands_text(bands: Sequence[int]) -> str:
    """Return the band numbers as ``--bands`` takes them: ``0-3,7``."""
    runs = np.split(np.array(bands, int), np.flatnonzero(np.diff(bands) != 1) + 1) if bands else []
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


# --- names of bands ---------------------------------------------------------------------------------------------------


def bands_of_names(names: Sequence[str | None], where: str, colours: Sequence[str] = ()) -> Bands:
    """Return (band,) facts by the one length, number or colour in each band's name, else by the file's own colours.

    A name with a length and another number, and colours that contradict the file's, give a note alone.
    """
    texts = [_without_number(name, place) for place, name in enumerate(names)]
    found = [_LENGTH.search(text) for text in texts]
    origin = f"wavelengths from the band names of {where}"
    if any(found):
        centres = np.full(len(names), np.nan)
        for at, length in enumerate(found):
            if length is None:
                continue
            if len(re.findall(r"\d+(?:\.\d+)?", texts[at])) > 1:
                return Bands(notes=(f"the band name {names[at]!r} may give several lengths",))
            centres[at] = _to_number(length[1]) * (scale_nm(length[2]) or np.nan)
            if not RANGE_NM[0] <= centres[at] <= THERMAL_NM:
                return Bands(notes=(f"the band name {names[at]!r} gives {centres[at]:g} nm, which is no wavelength",))
        known = centres[np.isfinite(centres)]
        if len(set(known)) < len(known):
            return Bands(notes=("the band names give several bands the same length",))
        return bands_of_numbers(centres, "nm", origin)
    plain = [_PLAIN.fullmatch(text.strip(" _-()[]")) for text in texts]
    numbers = np.array([np.nan if one is None else _to_number(one[1]) for one in plain])
    if are_wavelengths(numbers):
        return Bands(numbers, None, origin, ("the band names have no unit, read as nm by their size",))
    return _bands_of_colours(names, texts, where, colours)


def _without_number(name: str | None, place: int) -> str:
    """Return the text of a name without the number of its band: after such a word, or its ``place`` (from 0 or 1)."""

    def shortened(found: re.Match[str]) -> str:
        number, behind = int(found[2]), found.string[found.end() :].lstrip()
        said = bool(found[1].strip()) and (number < RANGE_NM[0] or behind.startswith("("))
        return " " if said or number in (place, place + 1) else found[0]

    text = re.sub(r"(?<!\d)(\d{1,2}),(?=\d)|(?<=\d),(?=\d{1,2}(?!\d))", r"\1.", _plain_text(name)[:MOST_NAME])
    return _BAND_NUMBER.sub(shortened, text)


def is_named(name: str | None, place: int) -> bool:
    """Return whether a band has a name that says more than its ``place`` (from 0 or 1)."""
    numbers = set(re.findall(r"\d+", _plain_text(name)[:MOST_NAME]))
    return bool(_without_number(name, place).strip()) or not {int(one) for one in numbers} <= {place, place + 1}


def _colour(text: str) -> set[float]:
    """Return the usual wavelengths of the colours in a text, NaN for infrared without a range."""
    words = re.sub(r"[\W_]+", " ", text).strip()
    values = list(_COLOURS.values())
    found = _COLOUR.finditer(_LETTERS.get(words, words))
    return {values[(one.lastindex or 1) - 1] for one in found}


def _bands_of_colours(names: Sequence[str | None], texts: Sequence[str], where: str, colours: Sequence[str]) -> Bands:
    """Return bands by the colours in their names, else by the file's own flags.

    A band without a name has the flag of the file; flags that GDAL writes by itself say nothing on a named one. A
    name with a number that may be a length has no colour.
    """
    default = tuple(colours[:3]) == ("red", "green", "blue") and set(colours[3:]) <= {"undefined", "alpha"}  # of GDAL
    flags = [_colour(colour) for colour in colours] or [set() for _ in names]
    bare = [not is_named(name, place) for place, name in enumerate(names)]
    if default and tuple(colours[3:]) == ("undefined",) and bare[3]:
        flags[3] = {NEAR_INFRARED_NM}
    named = [set() if _BARE.search(text) else _colour(text) for text in texts]
    by_flag = not default and not any(named)
    nm = [one or (flag if by_flag or no_name else set()) for one, no_name, flag in zip(named, bare, flags, strict=True)]
    centres = [min(one) if len(one) == 1 else np.nan for one in nm]
    if not centres or np.isnan(centres).any() or len(set(centres)) < len(centres):
        shown = ", ".join(repr(name) for name in names[:5]) + (", ..." if len(names) > 5 else "")
        doubt = f"the band names {shown} do not give each band a wavelength or a colour of its own"
        return Bands(notes=() if all(bare) else (doubt,))
    others = [at for at, flag in enumerate(flags) if flag and colours[at] != "gray" and flag != {centres[at]}]
    if others and not default:
        said = f"the band name {names[others[0]]!r} contradicts its colour in the file, {colours[others[0]]}"
        return Bands(notes=(said,))
    notes = ("the band names say other colours than the file's flags of red, green and blue: the names count",)
    source = f"the colours in the band names of {where}" if any(named) else "the file's colours"
    listed = ", ".join(f"{one:g}" for one in centres)
    origin = f"wavelengths assumed from {source}: {listed} nm"
    return Bands(np.array(centres), None, origin, notes if others else ())
