"""One image or array as it stands in its file, and what colours say of wavelengths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.readers.wavelengths import BandWavelengths

RGB_NM = (640.0, 550.0, 460.0)
NEAR_INFRARED_NM = 800.0
GREY_NM = 550.0


@dataclass(frozen=True)
class Raster:
    """One array as it stands in its file: (y, x) or (y, x, band), numbers of any kind."""

    values: NDArray[Any]
    assumed_nm: tuple[float, ...] | None = None  # what the file's colours suggest, band by band
    nodata: float | None = None
    notes: tuple[str, ...] = ()
    indices: NDArray[np.uint8] | None = None  # (y, x) of an image that numbers its colours
    known: BandWavelengths | None = None  # what the file says of its bands
    files: tuple[Path, ...] = ()  # that it was read from, where that is more than the one named
