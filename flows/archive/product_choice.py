"""Parse the flags of an export's products."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
        Switch, Parameter(help="Also all bands as GeoTIFF: the coarse mosaic, of a raster its own pixels.")
    ] = False
    indices: Annotated[
        str | None, Parameter(help="Spectral indices to write as GeoTIFF, with commas: NDVI,NDRE,MCARI,PRI.")
    ] = None
    polygons: Annotated[
        Switch, Parameter(help="Also the classes as polygons: GeoPackage, and GeoJSON where there is a CRS.")
    ] = False
    prescription: Annotated[
        str | None,
        Parameter(help="Doses by class, with commas: weed=2.5,grass=1. Written as shapefile and ISOXML task data."),
    ] = None
    dose_unit: Annotated[str, Parameter(help="Unit of the doses: l/ha or kg/ha.")] = "l/ha"
    cell: Annotated[
        float | None, Parameter(help="Side of the prescription's cells [m]; by default 3 m, or a pixel if larger.")
    ] = None
    heading: Annotated[float, Parameter(help="Heading of its cells, clockwise from north [deg].")] = 0.0
    least_fraction: Annotated[
        float, Parameter(help="A cell gets the dose of a class that covers more than this fraction of it, 0 to 1.")
    ] = 0.0
    least_area: Annotated[
        float, Parameter(help="Smaller regions are merged into a neighbour, in polygons and prescription [m2].")
    ] = 0.0
    buffer: Annotated[
        str | None, Parameter(help="Buffer around classes in polygons and prescription, with commas: weed=0.3 [m].")
    ] = None
    simplify: Annotated[
        float | None, Parameter(help="Tolerance for simplifying borders of polygons [m]; by default one pixel.")
    ] = None


NO_PRODUCTS = ProductFlags()


@dataclass(frozen=True)
class ProductChoice:
    """The parsed flags: indices, doses by class (empty without a prescription), their unit, and buffers by class."""

    flags: ProductFlags
    indices: tuple[SpectralIndex, ...]
    doses: Mapping[str, float]
    unit: DoseUnit
    buffers_m: Mapping[str, float]


def choose_products(flags: ProductFlags) -> ProductChoice:
    """Parse the flags (SettingsError: a number, an index or a unit is wrong, or has no product)."""
    doses = by_class(flags.prescription, "--prescription", "weed=2.5")
    numbers = (
        ("--least-area", flags.least_area, 0 <= flags.least_area < float("inf"), "0 or more"),
        ("--simplify", flags.simplify, 0 <= (flags.simplify or 0.0) < float("inf"), "0 or more"),
        ("--cell", flags.cell, flags.cell is None or 0 < flags.cell < float("inf"), "metres above 0"),
        ("--heading", flags.heading, abs(flags.heading) <= 360, "degrees from north"),
        ("--least-fraction", flags.least_fraction, 0 <= flags.least_fraction < 1, "a fraction from 0 to below 1"),
    )
    for name, value, is_right, expected in numbers:
        if not is_right:
            raise SettingsError(f"{name} expects {expected}, got {value:g}")
    if (flags.buffer or flags.least_area) and not (doses or flags.polygons):
        raise SettingsError("--buffer and --least-area shape polygons and prescriptions; ask for one of them as well")
    if flags.dose_unit not in UNITS:
        raise SettingsError(f"--dose-unit expects {' or '.join(UNITS)}, got {flags.dose_unit!r}")
    indices = tuple(dict.fromkeys(find_index(name) for name in split_list(flags.indices)))
    return ProductChoice(flags, indices, doses, UNITS[flags.dose_unit], by_class(flags.buffer, "--buffer", "weed=0.3"))


def by_class(text: str | None, flag: str, example: str) -> dict[str, float]:
    """Return the numbers by class of ``weed=2.5,grass=1`` (SettingsError: another form, or below 0)."""
    found = {}
    for part in split_list(text):
        name, _, number = part.partition("=")
        if not re.fullmatch(r"\s*\d+(\.\d*)?|\s*\.\d+", number) or not name.strip():
            raise SettingsError(f"{flag} expects classes with numbers, {example}, got {part!r}")
        found[name.strip()] = float(number)
    return found


def class_numbers(names: Sequence[str], wanted: Mapping[str, float], flag: str) -> dict[int, float]:
    """Return values by class number instead of name (SettingsError: the run has no such class)."""
    unknown = sorted(set(wanted) - set(names))
    if unknown:
        raise SettingsError(f"{flag}: the run has no class {unknown[0]!r}; its classes are {', '.join(names)}")
    return {names.index(name): value for name, value in wanted.items()}
