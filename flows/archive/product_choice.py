"""Parse the flags of an export's products."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from flows.cli.app import Switch, split_list
from pipeline.errors import SettingsError
from pipeline.products.indices import SpectralIndex, find_index
from storage.export.map_files import UNITS, DoseUnit


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ProductFlags:
    """Flags of the products to make of a run."""

    reflectance: Annotated[
        Switch,
        Parameter(help="Also all bands as GeoTIFF: the coarse mosaic, of a raster its pixels, both without noise."),
    ] = False
    indices: Annotated[
        str | None, Parameter(help="Spectral indices to write as GeoTIFF, with commas: NDVI,NDRE,MCARI,PRI.")
    ] = None
    polygons: Annotated[
        Switch, Parameter(help="Also the classes as polygons: GeoPackage, and GeoJSON where there is a CRS.")
    ] = False
    prescription: Annotated[
        str | None,
        Parameter(help="Doses by class, with commas: weed=2.5,grass=1. Written as GeoPackage and ISOXML task data."),
    ] = None
    dose_unit: Annotated[str, Parameter(help="Unit of the doses: l/ha or kg/ha.")] = "l/ha"
    cell: Annotated[
        float | None, Parameter(help="Side of the prescription's cells [m]; by default 3 m, or a pixel if larger.")
    ] = None


NO_PRODUCTS = ProductFlags()
MOST_CELL_M = 1000


@dataclass(frozen=True)
class ProductChoice:
    """The parsed flags: indices, doses by class (empty without a prescription) and their unit."""

    flags: ProductFlags
    indices: tuple[SpectralIndex, ...]
    doses: Mapping[str, float]
    unit: DoseUnit


def choose_products(flags: ProductFlags) -> ProductChoice:
    """Parse the flags (SettingsError: a number, an index or a unit is wrong)."""
    if flags.cell is not None and not 0 < flags.cell <= MOST_CELL_M:
        raise SettingsError(f"--cell expects metres above 0 and at most {MOST_CELL_M:g}, got {flags.cell:g}")
    if flags.dose_unit not in UNITS:
        raise SettingsError(f"--dose-unit expects {' or '.join(UNITS)}, got {flags.dose_unit!r}")
    for name in ("prescription", "indices"):
        if (given := getattr(flags, name)) is not None and not split_list(given):
            raise SettingsError(f"--{name} {given!r} names nothing; give names with commas, or leave it out")
    doses = {}
    for part in split_list(flags.prescription):
        name, _, number = part.partition("=")
        if not re.fullmatch(r"\s*\d+(\.\d*)?|\s*\.\d+", number) or not name.strip():
            known = "numbers are 0 or more, without an exponent"
            raise SettingsError(f"--prescription expects classes with numbers, weed=2.5, got {part!r}; {known}")
        if name.strip() in doses:
            raise SettingsError(f"--prescription names {name.strip()} twice; give it one number")
        doses[name.strip()] = float(number)
    if not doses and (flags.cell is not None or flags.dose_unit != NO_PRODUCTS.dose_unit):
        raise SettingsError("--cell and --dose-unit need --prescription, such as weed=2.5; give it or leave them out")
    indices = tuple(dict.fromkeys(find_index(name) for name in split_list(flags.indices)))
    return ProductChoice(flags, indices, doses, UNITS[flags.dose_unit])
