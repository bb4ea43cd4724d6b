"""A run of an archive and its exported files, read by independent libraries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import xarray as xr

from spectralzoom.pipeline.ground.view import RigPose

POSE = RigPose(lon_deg=9.5, lat_deg=52.1, heading_deg=25.0, tilt_deg=50.0, height_m=14.0)


@dataclass(frozen=True)
class Exported:
    """The archive, the run's receipt, and the folder and answer of its export."""

    archive: Path
    receipt: Any
    out: Path
    answer: dict[str, Any]

    @property
    def id(self) -> str:
        """Return the run's name."""
        return str(self.answer["run"])

    def file(self, key: str) -> Path:
        """Return the path of an exported file."""
        return self.out / str(self.answer["files"][key])

    def image(self, key: str) -> np.ndarray:
        """Return the first band of an exported image."""
        with rasterio.open(self.file(key)) as file:
            found: np.ndarray = file.read(1)
            return found

    def store(self, product: str, **how: Any) -> xr.Dataset:
        """Open a store of the archive."""
        return xr.open_zarr(self.archive / self.receipt["products"][product], consolidated=False, **how)

    def item(self) -> dict[str, Any]:
        """Return the STAC item."""
        found: dict[str, Any] = json.loads(Path(self.answer["item"]).read_text())
        return found
