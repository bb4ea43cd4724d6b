"""What weights were trained on: bands, light, season and scale. It stands in their record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

TRAINED_ON = "trained_on"  # its entry in a record

Range = tuple[float, float]


@dataclass(frozen=True)
class TrainedOn:
    """Ranges of what training saw; None where nobody knows."""

    bands: int
    wavelength_nm: Range
    exposure_ms: Range
    scenes: int
    classes: tuple[str, ...]
    day: tuple[int, int] | None = None  # of the year
    sun_elevation_deg: Range | None = None
    ground_pixel_m: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a record; `read` gives them back."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @staticmethod
    def read(content: Mapping[str, Any]) -> TrainedOn:
        """Read what `as_dict` gave. Raises KeyError, TypeError or ValueError where that is not what it is."""
        return TrainedOn(
            int(content["bands"]),
            _range(content["wavelength_nm"]),
            _range(content["exposure_ms"]),
            int(content["scenes"]),
            tuple(map(str, content["classes"])),
            None if content["day"] is None else (int(content["day"][0]), int(content["day"][1])),
            None if content["sun_elevation_deg"] is None else _range(content["sun_elevation_deg"]),
            None if content["ground_pixel_m"] is None else float(content["ground_pixel_m"]),
        )


def _range(values: Any) -> Range:
    low, high = map(float, values)
    return low, high
