"""What `spectralzoom statistics` does: every band of a stored product counted, as a table or as JSON."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.archive.commands import DONE
from flows.publish.receipt import to_json
from flows.terminal.figures import DASH, format_count
from flows.terminal.progress import StageProgress
from flows.terminal.shown_text import on_stdout
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.product_names import find_product
from storage.band_statistics import BandTable, cube_stores, product_statistics
from storage.parallel.crew import THREADS, Crew
from storage.remote.opening import open_archive
from storage.value_bins import RELATIVE_WIDTH

SHOWN = 12  # bands, where there are more
COLUMNS = ("band", "nm", "finite", "min", "2 %", "median", "98 %", "max", "mean", "std")
FIGURES = ("min", "p2", "p50", "p98", "max", "mean", "std")


def run_statistics(
    archive: str | Path,
    product: str,
    console: Console,
    *,
    crew: Crew = THREADS,
    every_band: bool = False,
    as_json: bool = False,
) -> int:
    """Count a product band by band; progress on ``console``, the figures on stdout.

    Raises
    ------
    ArchiveError : there is no such product.
    SettingsError : it is a run, or holds no cube.
    IncompleteStoreError : it is damaged.
    """
    opened = open_archive(archive, create=False, write=False)
    uri, stores = _stores_of(opened, product)
    with StageProgress(console, {"statistics": "statistics"}) as bars:
        table = product_statistics(stores, crew, report=lambda done: bars.show("statistics", done))
    content = {
        "archive": str(archive), "product": uri, "stores": [path.name for path in stores], "pixels": table.pixels,
        "percentile_error": RELATIVE_WIDTH, "bands": band_rows(table),
    }  # fmt: skip
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        _show(content, on_stdout(), every_band)
    return DONE


def band_rows(table: BandTable) -> list[dict[str, Any]]:
    """Figures of each band by name; None where no value is finite, or nothing says the wavelength."""
    columns = {
        "min": table.low, **{f"p{percent:g}": found for percent, found in table.percentiles.items()},
        "max": table.high, "mean": table.mean, "std": table.std,
    }  # fmt: skip
    return [
        {"band": band, "wavelength_nm": _known(nm), "finite": int(table.finite[band])}
        | {name: _known(column[band]) for name, column in columns.items()}
        for band, nm in enumerate(table.wavelength_nm)
    ]


def _known(value: np.floating[Any]) -> float | None:
    return float(value) if math.isfinite(value) else None


def _stores_of(archive: Archive, product: str) -> tuple[str, list[Path]]:
    """Address and cubes of a product."""
    found = find_product(Catalogue.read(archive.root), product)
    if not isinstance(found, str):
        raise SettingsError(f"{product} is a run; give one of its products, such as mosaic, raw_coarse or raw_fine")
    _, stage, key = found.split("/")
    ref = archive.find(stage, key)
    stores = [] if ref is None else cube_stores(ref.path)
    if not stores:
        raise SettingsError(
            f"{found} holds no cube of (y, x, band) or (line, sample, band); give a mosaic, raw lines or an ingested "
            "cube"
        )
    return found, stores


def _show(content: dict[str, Any], console: Console, every_band: bool) -> None:
    """Print some bands evenly from the first to the last, or all."""
    rows = content["bands"]
    count = len(rows) if every_band else min(SHOWN, len(rows))
    table = Table(title=escape(content["product"]), title_justify="left", title_style="bold", header_style="dim",
                  box=SIMPLE_HEAD, collapse_padding=True)  # fmt: skip
    for column in COLUMNS:
        table.add_column(column, justify="right", no_wrap=True)
    for number in np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int)):
        row = rows[number]
        share = row["finite"] / content["pixels"] if content["pixels"] else math.nan
        table.add_row(
            str(row["band"]), _figure(row["wavelength_nm"]), f"{share:.1%}", *(_figure(row[name]) for name in FIGURES)
        )
    console.print(table)
    shown = f"{count} of {len(rows)} bands, all with --all" if count < len(rows) else f"{len(rows)} bands"
    told = f"{shown}; {format_count(content['pixels'])} pixels each; percentiles within 1/{1 / RELATIVE_WIDTH:.0f}"
    console.print(told, highlight=False, soft_wrap=True)


def _figure(value: float | None) -> str:
    return DASH if value is None else f"{value:.4g}"
