"""The products that an export is asked for: flags, and what they mean, checked as far as words alone can be."""

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
    heading: Annotated[float, Parameter(help="Along which its cells lie, clockwise from north [deg].")] = 0.0
    least_fraction: Annotated[
        float, Parameter(help="A cell gets the dose of a class of which it has more than this fraction, 0 to 1.")
    ] = 0.0
    least_area: Annotated[
        float, Parameter(help="Regions below it go to their neighbour, in polygons and prescription [m2].")
    ] = 0.0
    buffer: Annotated[
        str | None, Parameter(help="How far classes grow in polygons and prescription, with commas: weed=0.3 [m].")
    ] = None
    simplify: Annotated[
        float | None, Parameter(help="By how much borders of polygons are simplified [m]; by default one pixel.")
    ] = None


NO_PRODUCTS = ProductFlags()


@dataclass(frozen=True)
class ProductChoice:
    """The flags as values: indices, doses by class (empty without a prescription) and their unit, metres by class."""

    flags: ProductFlags
    indices: tuple[SpectralIndex, ...]
    doses: Mapping[str, float]
    unit: DoseUnit
    buffers_m: Mapping[str, float]


def choose_products(flags: ProductFlags) -> ProductChoice:
    """Read the flags. Raises SettingsError: a number, an index or a unit that cannot be, or that nothing asks for."""
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
    """Return the numbers by class from ``weed=2.5,grass=1``. Raises SettingsError: not so, or less than 0."""
    found = {}
    for part in split_list(text):
        name, _, number = part.partition("=")
        if not re.fullmatch(r"\s*\d+(\.\d*)?|\s*\.\d+", number) or not name.strip():
            raise SettingsError(f"{flag} expects classes with numbers, {example}, got {part!r}")
        found[name.strip()] = float(number)
    return found


def class_numbers(names: Sequence[str], wanted: Mapping[str, float], flag: str) -> dict[int, float]:
    """Return the same by the numbers of a run's classes. Raises SettingsError: the run has no class of a name."""
    unknown = sorted(set(wanted) - set(names))
    if unknown:
        raise SettingsError(f"{flag}: the run has no class {unknown[0]!r}; its classes are {', '.join(names)}")
    return {names.index(name): value for name, value in wanted.items()}
