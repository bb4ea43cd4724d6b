"""Unpack numbers of arrays by CF: scale, offset, sign, fill values and valid range.

Scale and offset may be one a band, and the valid range counts; xarray does neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.array_files import FileArray
from spectralzoom.storage.readers.band_facts import MISSING

Turn = Callable[[NDArray[Any]], NDArray[Any]]
CODED = ("scale_factor", "add_offset", "_Unsigned")
FILLS = ("_FillValue", "missing_value")
ENDS = ("valid_range", "valid_min", "valid_max")


def packing_of(attributes: Mapping[str, Any], where: object, count: int = 1) -> dict[str, Any]:
    """Return the attributes of packing: numbers, of scale and offset one or ``count``, and _Unsigned.

    Fill values may be texts of numbers. Raises SceneError: scale, offset, a fill value or _Unsigned is something else.
    """
    stated = {name: attributes[name] for name in (*CODED, *FILLS, *ENDS) if name in attributes}
    stated |= {name: _numbers(stated[name], f"{where} has {name}") for name in set(FILLS) & set(stated)}
    known = {name: value for name, value in stated.items() if np.asarray(value).dtype.kind in "iuf"}
    if "_Unsigned" in stated:
        sign = str(stated["_Unsigned"]).lower()
        known["_Unsigned"] = sign if sign in ("true", "false") else None
    for name in set(CODED) & set(stated):
        if known.get(name) is None or np.size(known[name]) not in (1, count):
            allowed = (
                "true or false" if name == "_Unsigned" else "one number" + (", or one a band" if count > 1 else "")
            )
            raise SceneError(f"{where} has {name} = {shown(attributes[name])}, expected {allowed}; correct it")
        if name != "_Unsigned":
            numbers = np.ravel(known[name]).astype(np.float64)
            known[name] = numbers if numbers.size > 1 else numbers[0]
    return known


def _numbers(value: Any, what: str) -> Any:
    """Return numbers, also those of texts; none for a text that states none (SceneError: another text)."""
    if np.asarray(value).dtype.kind in "iufb":
        return value
    try:
        texts = [str(one).strip() for one in np.ravel(np.asarray(value, object)).tolist()]
        return [float(text) for text in texts if text.lower() not in MISSING]
    except ValueError:
        raise SceneError(f"{what} = {shown(value)!r}, expected a number; correct it") from None


def shown(value: object) -> str:
    """Return an attribute as text of one line."""
    return " ".join(str(value).split())[:80]


def unpacking(about: Mapping[str, Any], stored: np.dtype[Any]) -> tuple[Turn | None, float | None]:
    """Return the function from numbers of a file to values, NaN where there is none, and the no-data value.

    The function is None where the numbers are the values, with one no-data value at most. A fill value that the numbers
    cannot hold is that of scaled values.
    """
    kind = stored
    if "_Unsigned" in about and stored.kind in "iu":
        kind = np.dtype(f"{stored.byteorder}{'u' if about['_Unsigned'] == 'true' else 'i'}{stored.itemsize}")
    scale, offset = about.get("scale_factor", 1.0), about.get("add_offset", 0.0)
    scaled = bool(np.any(scale != 1) or np.any(offset != 0))
    listed = {number: _held(number, stored, kind) for name in FILLS for number in np.ravel(about.get(name, ()))}
    fills = list(dict.fromkeys(one for one in listed.values() if one is not None))
    late = [float(number) for number, one in listed.items() if one is None] if scaled else []
    pair = about.get("valid_range", (about.get("valid_min"), about.get("valid_max")))
    pair = pair if np.size(pair) == 2 else (None, None)
    # floating ends of whole numbers with a scale are values, others are packed (NetCDF Users Guide, conventions)
    are_values = [scaled and stored.kind in "biu" and np.asarray(end).dtype.kind == "f" for end in pair]
    low, high = (
        None if end is None else float(end) if is_value else _held(end, stored, kind)
        for end, is_value in zip(pair, are_values, strict=True)
    )
    if not scaled and "_Unsigned" not in about and len(fills) < 2 and (low, high) == (None, None):
        return None, fills[0] if fills else None

    def unpack(numbers: NDArray[Any]) -> NDArray[Any]:
        packed = numbers.view(kind)
        values = packed * scale + offset if scaled else packed
        out = np.isin(packed, fills)
        out |= False if low is None else (values if are_values[0] else packed) < low
        out |= False if high is None else (values if are_values[1] else packed) > high
        return np.where(out, np.float32(np.nan), values)

    return unpack, late[0] if late else None


def _held(number: Any, stored: np.dtype[Any], kind: np.dtype[Any]) -> float | None:
    """Return a number of an attribute as the ``kind`` of number in the file; None where the file cannot hold it."""
    if stored.kind == "f":
        return float(number)
    if np.isfinite(number) and int(number) == number:
        for one in (stored, kind):  # _Unsigned may be written with either sign
            if np.iinfo(one).min <= number <= np.iinfo(one).max:
                return int(np.array(int(number), one).view(kind))
    return None


def values_of(one: FileArray) -> NDArray[Any]:
    """Return an array whole, with its scale and offset (SceneError: as `packing_of`)."""
    packing = packing_of(one.attrs, one.where)
    unpack, _ = unpacking({name: packing[name] for name in CODED if name in packing}, one.dtype)
    return one[...] if unpack is None else unpack(one[...])
