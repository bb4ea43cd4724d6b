"""Read an archive: its runs by name, and their products as xarray.

Every axis has a coordinate; bands are selected by wavelength, classes are numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spectralzoom.pipeline.errors import IncompleteStoreError, NoRunError
from spectralzoom.storage.arrays.layout import damage_named, open_group
from spectralzoom.storage.runs import LINE_PRODUCTS, Run, read_run
from spectralzoom.storage.store import LATEST, Archive, damage

if TYPE_CHECKING:
    import pandas
    import xarray


def open(archive: str | Path) -> OpenedArchive:
    """Open an archive for reading.

    Parameters
    ----------
    archive
        Its folder.

    Returns
    -------
    OpenedArchive
        The published runs by name.

    Raises
    ------
    ArchiveError
        There is no archive, or it cannot be read.
    """
    return OpenedArchive(Archive.open(archive, create=False, write=False))


class OpenedArchive(Mapping[str, "OpenedRun"]):
    """The published runs of an archive by name, the latest first; ``latest`` also names the first."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    @property
    def name(self) -> str:
        """Address of the archive."""
        return self._archive.name

    @property
    def latest(self) -> OpenedRun:
        """The run published last. Raises NoRunError without one."""
        return self[LATEST]

    def compare(self, earlier: str, later: str) -> pandas.DataFrame:
        """Return how much of each class of one run is which class of another one.

        Parameters
        ----------
        earlier, later
            Names of two runs on one grid.

        Returns
        -------
        pandas.DataFrame
            A row for each earlier class and a column for each later one. ``attrs["unit"]`` is ``ha`` if both runs know
            the size of their pixels, else ``px``. Pixels without a class in one of both are left out.

        Raises
        ------
        Error
            There is no such run, or the grids differ.
        """
        from spectralzoom.class_figures import class_changes

        return class_changes(self[earlier], self[later])

    def __getitem__(self, name: str) -> OpenedRun:
        if not isinstance(name, str):
            raise NoRunError(f"a run is named by text, got {name!r}")
        return OpenedRun(self._archive, self._archive.run_folder(name))

    def __iter__(self) -> Iterator[str]:
        return (folder.name for folder in reversed(self._archive.runs()))

    def __len__(self) -> int:
        return len(self._archive.runs())

    def __repr__(self) -> str:
        return "\n".join([f"spectralzoom archive {self.name}, {len(self)} runs", *(f"  {name}" for name in self)])


class OpenedRun:
    """One published run, by `OpenedArchive`. Arrays are read when they are used.

    Class map, confidence, mosaic and class probabilities lie on the scene's grid: in its CRS, else in directions from
    the rig [rad]. A run with a ``[pose]`` also has a ``ground_map``.
    """

    def __init__(self, archive: Archive, folder: Path) -> None:
        self._archive = archive
        self.folder = folder  # on this machine

    @property
    def name(self) -> str:
        """Name in the archive: time of publication, and the field."""
        return self.folder.name

    @cached_property
    def receipt(self) -> Mapping[str, Any]:
        """Receipt of the run: settings, stages, savings, accuracy, products.

        Raises IncompleteStoreError: it is damaged.
        """
        found: Run = read_run(self.folder)
        if found.problem is not None:
            raise damage(self.folder, found.problem)
        return found.receipt

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the map: reasons to expect a poorer one. It then has no expected score."""
        from spectralzoom.flows.publish.scores import warnings_of

        return tuple(warnings_of(self.receipt))

    @property
    def report(self) -> Path:
        """Path of the report, one HTML file."""
        return self._archive.locate(f"runs/{self.name}/report.html")

    @property
    def quicklook(self) -> Path:
        """Path of the quicklook, a PNG."""
        return self._archive.locate(f"runs/{self.name}/quicklook.png")

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, by their numbers in the class map."""
        return tuple(self.dataset("class_map").attrs["class_names"])

    @property
    def class_map(self) -> xarray.DataArray:
        """(y, x) uint8 class numbers, 255 without a class; names in ``flag_meanings``."""
        return self.dataset("class_map")["classes"]

    @property
    def confidence(self) -> xarray.DataArray:
        """(y, x) float32 probability of the mapped class, 0 to 1; NaN without a class."""
        return self.dataset("class_map")["confidence"]

    @property
    def mosaic(self) -> xarray.DataArray:
        """(y, x, band) float32 values of all passes, NaN where not captured, by rising ``wavelength``, an index.

        Spectra are restored from their components when they are used.
        """
        from spectralzoom.spectra import open_lazy_mosaic

        return open_lazy_mosaic(self._place("mosaic"))

    def index(self, name: str) -> xarray.DataArray:
        """Return a spectral index of the mosaic by its name in Awesome Spectral Indices, (y, x) float32.

        Parameters
        ----------
        name
            Such as ``NDVI``, in any case.

        Returns
        -------
        xarray.DataArray
            NaN where a pixel has no value or is darker than 1 % of white. It is computed when it is used.

        Raises
        ------
        Error
            There is no such index, the mosaic lacks its bands, or its values are not the reflectance that it needs.
        """
        from spectralzoom.class_figures import index_map

        return index_map(self._place("mosaic"), self.name, name)

    def spectra(self) -> xarray.Dataset:
        """Return ``mean`` and ``std`` of the spectra of each mapped class, (class_name, band), and its ``pixels``.

        A class without a pixel has NaN. Pixels without a value in some band are left out.
        """
        from spectralzoom.class_figures import class_spectra

        return class_spectra(self._place("mosaic"), self.class_map.values, self.class_map.attrs, self.class_names)

    @property
    def lines(self) -> dict[str, xarray.DataArray]:
        """Calibrated lines by the sweep's name: (line, sample, band) float32, NaN for unusable spectra.

        They are restored from their components and from residuals of rare spectra when they are used. Time, mirror and
        exposure of each line are coordinates.
        """
        from spectralzoom.spectra import open_lazy_lines

        names = [name for name in LINE_PRODUCTS.values() if name in self.receipt["products"]]
        return {path.stem: open_lazy_lines(path) for path in self._sweeps_of(names)}

    @property
    def attention(self) -> xarray.Dataset:
        """Expected gain (``score``) and order (``rank``, -1: not chosen) of every patch, (patch_y, patch_x)."""
        return self.dataset("attention")

    @property
    def ground_map(self) -> xarray.Dataset:
        """Images on the ground of a survey with a ``[pose]``; their CRS is in ``spatial_ref``.

        They are ``classes``, ``confidence`` and ``picture``. A later visit also has ``changed_from``
        (previous class, 255 where unchanged).
        """
        return self.dataset("ground_map")

    @property
    def sweeps(self) -> dict[str, xarray.Dataset]:
        """Raw lines by the sweep's name: ``dn`` (line, sample, band), with time and mirror of each line.

        Raises IncompleteStoreError: they were cleared away by the setting ``keep``; `lines` stay.
        """
        names = [name for name in LINE_PRODUCTS if name in self.receipt["products"]]
        for name in names:
            if not self._archive.is_there("/".join(self.receipt["products"][name].split("/")[:3])):
                raise IncompleteStoreError(
                    f"the raw lines of {self.name} were cleared away once they were condensed; `lines` has their"
                    " signal. A survey with keep = raw keeps raw lines"
                )
        return {path.stem: open_labelled(path) for path in self._sweeps_of(names)}

    def _sweeps_of(self, names: list[str]) -> list[Path]:
        folders = [self._archive.locate(self.receipt["products"][name]) for name in names]
        return [path for folder in folders for path in sorted(folder.glob("*.zarr"))]

    @property
    def products(self) -> tuple[str, ...]:
        """Names of the products for `dataset`."""
        return tuple(name for name, where in self.receipt["products"].items() if where.endswith(".zarr"))

    def dataset(self, product: str) -> xarray.Dataset:
        """Return all arrays of a product, such as ``class_probabilities`` or ``geolocation``.

        Raises IncompleteStoreError: the run has no such product, or it is damaged.
        """
        return open_labelled(self._place(product))

    def _place(self, product: str) -> Path:
        if product not in self.products:
            raise IncompleteStoreError(f"the run {self.name} has no {product}. It has {', '.join(self.products)}")
        return self._archive.locate(self.receipt["products"][product])

    def __repr__(self) -> str:
        score = (self.receipt.get("accuracy") or {}).get("miou")
        known = "" if score is None else f", mIoU {100 * score:.1f}"
        warned = "".join(f", warning: {one}" for one in self.warnings)
        return f"<run {self.name} of {self._archive.name}{known}{warned}>"


def open_labelled(path: Path) -> xarray.Dataset:
    """Open a store lazily, in dask's blocks of whole shards, with a coordinate on every axis.

    ``y`` and ``x`` are in metres for a georeferenced store (its CRS in ``spatial_ref``). Otherwise they are tangents of
    the angle from the undeflected direction [rad], or pixels. ``band`` and ``wavelength`` are in nm, rising, both an
    index; ``detector`` numbers the detectors of overlapping bands.
    Numbers keep their type: no class becomes a float. Attributes are text, numbers or lists of them, others JSON text,
    so that ``to_netcdf`` and ``to_zarr`` write them. Raises IncompleteStoreError: the store is missing or damaged.
    """
    import xarray  # takes a second

    from spectralzoom.spectra import with_plain_attributes
    from spectralzoom.storage.arrays.band_order import by_wavelength

    with damage_named(str(path)):
        store: Any = open_group(path).store  # xarray takes a path with :: for a chain of file systems
        opened = xarray.open_dataset(
            store, engine="zarr", consolidated=False, mask_and_scale=False, chunks=None, cache=False
        )
        opened = by_wavelength(opened)
        for name, one in opened.data_vars.items():
            blocks = one.encoding.get("shards") or one.encoding.get("chunks") or one.shape
            opened = opened.assign({name: one.chunk(dict(zip(one.dims, blocks, strict=True)))})
    bare = {name: np.arange(size) for name, size in opened.sizes.items() if name not in opened.variables}  # as rgb
    return with_plain_attributes(opened.assign_coords(bare))
