"""Describe the parts of a weights file beside the network: out-of-distribution detector and temporal reader."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from models.evaluation.expected_scores import MapScores
from models.network.sizes import SegmenterConfig, TemporalSizes

OOD, READER = "familiar", "memory"  # entries in the description, prefixes of tensor names
TRAINED_ON = "trained_on"  # entry in a record
MAP_SCORES = "map_scores"  # of a record: corrections of expected scores
MOST_WIDTH = 1024

Range = tuple[float, float]


@dataclass(frozen=True)
class TrainedOn:
    """Ranges of the training data; None where unknown."""

    bands: int
    wavelength_nm: Range
    exposure_ms: Range
    scenes: int
    classes: tuple[str, ...]
    day: tuple[int, int] | None = None  # of the year
    sun_elevation_deg: Range | None = None
    ground_pixel_m: float | None = None
    bands_nm: tuple[float, ...] | None = None  # centre of each band

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for a record."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @staticmethod
    def read(content: Mapping[str, Any]) -> TrainedOn:
        """Read values of `as_dict`. Raises TypeError for other entries."""
        return TrainedOn(
            **{name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
        )


@dataclass(frozen=True)
class OodPart:
    """Description of the out-of-distribution detector."""

    key: str  # hash
    trained_on: TrainedOn
    steps: tuple[int, ...]
    bands: int
    record: Mapping[str, Any]  # command, scenes, calibration, map scores

    @staticmethod
    def read(key: str, about: Mapping[str, Any]) -> OodPart:
        """Read an entry of a description. Raises KeyError, TypeError or ValueError for an invalid one."""
        trained_on, steps = TrainedOn.read(about[TRAINED_ON]), tuple(map(int, about["steps"]))
        found = OodPart(key, trained_on, steps, int(about["bands"]), about["record"])
        _ = found.map_scores  # raises for invalid ones
        return found

    @property
    def map_scores(self) -> MapScores | None:
        """Return the corrections of expected scores; None for weights of a single exposure."""
        scores = self.record.get(MAP_SCORES)
        return None if scores is None else MapScores.read(scores)


@dataclass(frozen=True)
class ReaderPart:
    """Description of the temporal reader."""

    key: str
    sizes: TemporalSizes
    record: Mapping[str, Any]

    @staticmethod
    def read(key: str, about: Mapping[str, Any], config: SegmenterConfig) -> ReaderPart:
        """Read an entry of a description. KeyError, TypeError, ValueError: invalid, or for another network."""
        sizes = TemporalSizes(**about["sizes"])
        if (sizes.classes, sizes.columns) != (config.classes, config.columns):
            raise ValueError(f"its temporal reader is for another network: {sizes}")
        if not 0 < sizes.width <= MOST_WIDTH or not 0 < sizes.coarse_width <= MOST_WIDTH:
            raise ValueError(f"its temporal reader is {sizes.width} and {sizes.coarse_width} wide")
        return ReaderPart(key, sizes, about["record"])
