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
SAME = 1.02  # ratio of two lengths up to which one is the other, rounded
# spelling of a unit: its length [nm]; the first ones may stand behind a number in the name of a band
_LENGTHS: Mapping[str, float] = {
    r"nm|nano ?-?met(?:er|re)s?": 1.0,
    r"[uμ]m|microns?|micro ?-?met(?:er|re)s?": 1000.0,
    r"å|[aå]ngstr(?:o|ö|oe)ms?": 0.1,
    r"m|met(?:er|re)s?": 1e9,
}
_BY_SIZE = {"nm": 1.0, "micrometres": 1000.0, "metres": 1e9}
_UNSAID = ("", "unknown", "none", "unspecified", "-", "1")
MISSING = ("", "nan", "n/a", "na", "none", "null", "-", "--", "?", "unknown", "missing")
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
# whole names, without case and signs, of STAC's EO extension and plain words: usual, least and greatest wavelength [nm]
_NAMED: Mapping[str, tuple[float, float, float]] = {
    name: wavelengths
    for names, wavelengths in (
        ("coastal coastalaerosol coastalblue aerosol", (443.0, 400.0, 460.0)),
        ("blue b", (460.0, 420.0, 530.0)),
        ("green g", (550.0, 490.0, 610.0)),
        ("yellow", (590.0, 565.0, 630.0)),
        ("orange", (620.0, 585.0, 650.0)),
        ("red r", (640.0, 590.0, 710.0)),
        ("rededge", (717.0, 670.0, 800.0)),
        ("rededge1 rededge071", (705.0, 690.0, 730.0)),
        ("rededge2 rededge075", (740.0, 725.0, 765.0)),
        ("rededge3 rededge078", (783.0, 760.0, 800.0)),
        ("nir nearinfrared nearir n", (800.0, 700.0, 1400.0)),
        ("nir08", (865.0, 750.0, 900.0)),
        ("nir09", (945.0, 850.0, 1050.0)),
        ("cirrus", (1375.0, 1340.0, 1410.0)),
        ("swir1 swir16", (1610.0, 1500.0, 1800.0)),
        ("swir2 swir22", (2200.0, 2000.0, 2400.0)),
        ("gray grey pan panchromatic", (550.0, 0.0, np.inf)),
    )
    for name in names.split()
}


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


def unit_of(attrs: Mapping[str, Any]) -> str:
    """Return the unit that attributes state as ``units`` or ``unit``, in any case; empty without one."""
    said = {letters(key): str(value).strip() for key, value in attrs.items() if value is not None}
    return said.get("units") or said.get("unit", "")


def is_spectral(attrs: Mapping[str, Any]) -> bool:
    """Return whether attributes are those of wavelengths, by their standard name or a unit of nm, um or Angstrom."""
    short = scale_nm(unit_of(attrs))
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
    return _plain_text(word) in MISSING or re.fullmatch(rf"[+-]?{_NUMBER}", _plain_text(word)) is not None


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

    A field such as ``wavelength`` or ``band centres (um)`` is a list in one text, or has one text or number a band. The
    first list counts; a note tells which other list or name contradicts it. ``colours`` are GDAL's interpretations.
    """
    count = len(names)
    names = names if any(names) else _listed_names(fields, count)
    key, listed = bands_of_lists(fields, count, where)
    if listed.wavelength_nm is not None:
        said = [(f"the band name {name!r}", *_named_range(name, place)) for place, name in enumerate(names)]
        wrong = _contradiction(key, listed.wavelength_nm, said)
        return replace(listed, notes=tuple(dict.fromkeys([*listed.notes, *wrong])))
    found = bands_of_names(names, where, () if listed.notes else colours)
    return replace(found, notes=(*listed.notes, *found.notes))


def bands_of_lists(fields: Mapping[str, object], count: int, where: str) -> tuple[str, Bands]:
    """Return the key of the first list of wavelengths in a file's fields, and (band,) facts by it; else notes alone."""
    notes: list[str] = []
    first: tuple[str, Bands, NDArray[np.float64]] | None = None
    for key, numbers, unit in _lists(fields, CENTRES, count, notes):
        _, *widths = next(_lists(fields, WIDTHS, count, notes), ("",))
        found = bands_of_numbers(numbers, unit, f"wavelengths from the list {key} of {where}", *widths)
        if first is None:
            notes += found.notes
            first = None if found.wavelength_nm is None else (key, found, found.wavelength_nm)
        elif found.wavelength_nm is not None:
            notes += _contradiction(*first[::2], [(key, nm, nm) for nm in found.wavelength_nm.tolist()])
    return ("", Bands(notes=tuple(notes))) if first is None else (first[0], replace(first[1], notes=tuple(notes)))


def _contradiction(key: str, nm: NDArray[np.float64], others: Sequence[tuple[str, float, float]]) -> list[str]:
    """Return a note on the first band of which ``others`` give a range [nm] beyond its wavelength in the list."""
    pairs = zip(nm.tolist(), others, strict=True)
    wrong = [at for at, (own, (_, low, high)) in enumerate(pairs) if own * SAME < low or own > high * SAME]
    if not wrong:
        return []
    at, more = wrong[0], f" (so in {len(wrong)} bands)" if len(wrong) > 1 else ""
    return [f"band {at} is {nm[at]:g} nm by {key}, which counts; {others[at][0]} says another{more}"]


def _listed_names(fields: Mapping[str, object], count: int) -> Sequence[str | None]:
    """Return the names that a field lists, one a band; None each without such a list."""
    for key, value in fields.items():
        if letters(key) in ("bandname", "bandnames", "longname"):
            words = value.split(",") if isinstance(value, str) else _words(value)
            if len(words) == count:
                return [str(word).strip() for word in words]
    return [None] * count


def _lists(
    fields: Mapping[str, object], kind: re.Pattern[str], count: int, notes: list[str]
) -> Iterator[tuple[str, NDArray[np.float64], object]]:
    """Yield key, (band,) numbers and unit of each list of a kind; ``notes`` say why others are left out."""
    units = {letters(key).removesuffix("s"): value for key, value in fields.items() if "unit" in key.lower()}
    of_kind = [value for key, value in units.items() if kind.fullmatch(key.removesuffix("unit"))]
    bare = units.get("unit", "")  # of the values, unless it is one of lengths
    of_kind += [bare] * all(_plain_text(one) in _UNSAID or scale_nm(one) for one in _words(bare))
    for key in sorted(fields, key=len):
        if (known := kind.fullmatch(letters(key))) is None:
            continue
        value, unit = fields[key], units.get(f"{letters(key)}unit", of_kind[0] if of_kind else "")
        words = (split_list(value, count) if isinstance(value, str) else None) or _words(value)
        wrong = [word for word in words if not _is_number(word)]
        stated = [unit] if isinstance(unit, str) else [one for one in _words(unit) if _plain_text(one) not in _UNSAID]
        several = {scale_nm(one) or str(one) for one in stated}  # a band without one has that of the others
        if wrong or len(words) != count or len(several) > 1:
            why = f"{str(wrong[0])!r} is no number" if wrong else f"{len(words)} for {count} bands"
            notes.append(f"{key} is left out: {'it has several units' if len(several) > 1 else why}")
            continue
        yield key, np.array([_to_number(word) for word in words]), known[1] or (stated or [""])[0]


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
    """Return (band,) facts by the one length in each band's name, or its whole name, else by the file's own colours.

    A name with a length and another number, and colours that contradict the file's, give a note alone.
    """
    centres = np.full(len(names), np.nan)
    for at, name in enumerate(names):
        length, doubt = _length(name, at)
        if doubt:
            return Bands(notes=(f"the band name {name!r} {doubt}",))
        centres[at] = length
    known = centres[np.isfinite(centres)]
    if not known.size:
        return _bands_of_colours(names, where, colours)
    if len(set(known)) < len(known):
        return Bands(notes=("the band names give several bands the same length",))
    return bands_of_numbers(centres, "nm", f"wavelengths from the band names of {where}")


def _length(name: str | None, place: int) -> tuple[float, str]:
    """Return the only length in a name [nm], NaN without one; and why it is doubtful: a width, or one of several."""
    text = _without_number(name, place)
    if (found := _LENGTH.search(text)) is None:
        return np.nan, ""
    several = len(re.findall(r"\d+(?:\.\d+)?", text)) > 1
    if several or WIDTHS.search(letters(text)) or re.search("[<>≤≥±~]", text):
        return np.nan, "may give several lengths"
    nm = _to_number(found[1]) * (scale_nm(found[2]) or np.nan)
    return nm, "" if RANGE_NM[0] <= nm <= THERMAL_NM else f"gives {nm:g} nm, which is no wavelength"


def _named_range(name: str | None, place: int) -> tuple[float, float]:
    """Return the least and greatest wavelength [nm] of a band by its length or whole name; any without one."""
    nm, doubt = _length(name, place)
    if nm > 0 and not doubt:
        return nm, nm
    return _NAMED.get(_whole_name(name, place), (0.0, 0.0, np.inf))[1:]


def _whole_name(name: str | None, place: int) -> str:
    """Return a name without signs, the words band and channel, and the ``place`` (from 0 or 1) as a number."""
    return re.sub(r"[\W_]+|band|channel", "", _without_number(name, place, counted=False))


def _without_number(name: str | None, place: int, *, counted: bool = True) -> str:
    """Return the text of a name without its ``place`` (from 0 or 1), or any number ``counted`` by a word before it."""

    def shortened(found: re.Match[str]) -> str:
        number, behind = int(found[2]), found.string[found.end() :].lstrip()
        said = counted and bool(found[1].strip()) and (number < RANGE_NM[0] or behind.startswith("("))
        return " " if said or number in (place, place + 1) else found[0]

    text = re.sub(r"(?<!\d)(\d{1,2}),(?=\d)|(?<=\d),(?=\d{1,2}(?!\d))", r"\1.", _plain_text(name)[:MOST_NAME])
    return _BAND_NUMBER.sub(shortened, text)


def is_named(name: str | None, place: int) -> bool:
    """Return whether a band has a name that says more than its ``place`` (from 0 or 1)."""
    numbers = set(re.findall(r"\d+", _plain_text(name)[:MOST_NAME]))
    return bool(_without_number(name, place).strip()) or not {int(one) for one in numbers} <= {place, place + 1}


def _bands_of_colours(names: Sequence[str | None], where: str, colours: Sequence[str]) -> Bands:
    """Return bands by their whole names, else by the file's own flags.

    A band without a name has the flag of the file; flags that GDAL writes by itself say nothing on a named one.
    """
    default = tuple(colours[:3]) == ("red", "green", "blue") and set(colours[3:]) <= {"undefined", "alpha"}  # of GDAL
    bare = np.array([not is_named(name, place) for place, name in enumerate(names)], np.bool_)
    flags, named = (
        np.array([_NAMED.get(word, (np.nan,))[0] for word in words])
        for words in (colours or [""] * len(names), [_whole_name(name, place) for place, name in enumerate(names)])
    )
    if default and tuple(colours[3:]) == ("undefined",) and bare[3]:
        flags[3] = _NAMED["nir"][0]
    by_flag = bare | (not default and bool(np.isnan(named).all()))
    nm = np.where(np.isnan(named) & by_flag, flags, named)
    if not nm.size or np.isnan(nm).any() or len(set(nm)) < len(nm):
        shown = ", ".join(repr(name) for name in names[:5]) + (", ..." if len(names) > 5 else "")
        doubt = f"the band names {shown} do not give each band a length with its unit, or a known colour of its own"
        return Bands(notes=() if bare.all() else (doubt,))
    others = [at for at in np.flatnonzero(~np.isnan(flags) & (flags != nm)).tolist() if colours[at] != "gray"]
    if others and not default:
        said = f"the band name {names[others[0]]!r} contradicts its colour in the file, {colours[others[0]]}"
        return Bands(notes=(said,))
    notes = ("the band names say other colours than the file's flags of red, green and blue: the names count",)
    source = "the file's colours" if np.isnan(named).all() else f"the colours in the band names of {where}"
    listed = ", ".join(f"{one:g}" for one in nm)
    return Bands(nm, None, f"wavelengths assumed from {source}: {listed} nm", notes if others else ())


def axis_hint(shape: Sequence[int], count: int) -> str:
    """Return what to type where another axis of (y, x, band) ``shape`` has ``count`` numbers; empty without one."""
    fits = [axis for axis, size in enumerate(shape) if size == count]
    if len(fits) != 1 or fits[0] == 2:
        return ""
    ways = "[2 3 1] or numpy.moveaxis(cube, 0, -1) of (band, y, x), [3 2 1] or cube.T of (band, x, y)"
    ways = ways if fits[0] == 0 else "[1 3 2] or numpy.moveaxis(cube, 1, -1)"
    return (
        f"; axis {fits[0]} (from 0) of {tuple(shape)} has {count}, so if these are the bands, store the cube as (y, x, "
        f"band) by MATLAB's permute {ways}"
    )
