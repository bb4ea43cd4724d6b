"""Check the numbers in the description of weights against the range of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RANGES: dict[str, tuple[float, float]] = {
    "temperature": (0.01, 100),
    "class_values": (0, 254),
    "bands": (1, 1e6),
    "scenes": (0, 1e6),
    "steps": (1, 1024),
    "day": (1, 366),
    "sun_elevation_deg": (-90, 90),
    "ground_pixel_m": (1e-6, 1e6),
    **dict.fromkeys(("wavelength_nm", "bands_nm"), (200, 3000)),
    **dict.fromkeys(("exposure_ms", "exposures_ms"), (1e-3, 1e6)),
    **dict.fromkeys(("miou", "spread", "per_class_iou", "error", "fraction"), (0, 1)),
    "least_gain": (1e-6, 1),
    "loss": (-1, 1),
    "bias": (-100, 100),
}
MAY_LACK = ("day", "sun_elevation_deg", "ground_pixel_m", "bands_nm")  # null where unknown
SCORES = ("miou", "spread", "per_class_iou", "error", "loss")  # null or NaN where no pixel has a label
READ = ("calibration", "trained_on", "scans", "cascade", "validation")  # tables of a record


def check_record(record: Mapping[str, Any], parts: int) -> None:
    """Raise ValueError for an entry that is no table, or has a number beyond its range; of the mixture's ``parts``."""
    tables = {name: record.get(name) or {} for name in (*READ, "split")}
    if wrong := [name for name, table in tables.items() if not isinstance(table, Mapping)]:
        raise ValueError(f"its {wrong[0]} is {tables[wrong[0]]!r}, expected a table")
    check_ranges([*map(tables.get, READ), {"class_values": record.get("class_values") or []}])
    if record.get("plain") is not None and record["plain"] not in range(parts):
        raise ValueError(f"its plain classifier is {record['plain']!r}, expected a number below {parts}")


def check_ranges(content: Any, name: str = "") -> None:
    """Raise ValueError for a number in tables and lists that is beyond the range of its ``name``."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            check_ranges(value, name or (key if key in RANGES else ""))
    elif isinstance(content, list):
        for value in content:
            check_ranges(value, name)
    elif name and not (content is None and name in (*MAY_LACK, *SCORES)):
        low, high = RANGES[name]
        is_number = isinstance(content, int | float) and not isinstance(content, bool)
        if not is_number or not (low <= content <= high or (content != content and name in SCORES)):
            raise ValueError(f"its {name} is {content!r}, expected a number from {low:g} to {high:g}")
