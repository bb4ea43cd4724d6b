"""An archive opened to look at: its runs by name, and what each left as xarray.

Every axis has a coordinate, as the stores name it; bands are found by wavelength, classes are numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ArchiveError, IncompleteStoreError
from pipeline.lazy import deferred
from storage.archive.archive import Archive
from storage.archive.records import Run, read_run
from storage.arrays.layout import damage_named
from storage.readers.recordings import LINE_PRODUCTS

if TYPE_CHECKING:
    import xarray

    import spectralzoom.spectra as spectra
    import storage.remote.opening as opening
else:
    spectra = deferred("spectralzoom.spectra")
    opening = deferred("storage.remote.opening")
    xarray = deferred("xarray")  # a second, which most commands do without

LATEST = "latest"
PICTURES = ("quicklook",)  # for viewers, on axes of their own


def open(archive: str | Path) -> OpenedArchive:
    """Open an archive to look at: a folder, or s3://bucket/prefix. Nothing is written to it.

    Raises ArchiveError: there is none, or it cannot be read.
    """
    return OpenedArchive(opening.open_archive(archive, create=False, write=False))


class OpenedArchive(Mapping[str, "OpenedRun"]):
    """The published runs of an archive by their names, the latest first; `latest` is a name of the first as well."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    @property
    def name(self) -> str:
        """The address that it was opened by."""
        return self._archive.name

    @property
    def runs(self) -> Mapping[str, OpenedRun]:
        """The runs, by their names, the latest first: the archive itself."""
        return self

    @property
    def latest(self) -> OpenedRun:
        """The run published last. Raises ArchiveError where there is none."""
        return self[LATEST]

    def __getitem__(self, name: str) -> OpenedRun:
        folders = {folder.name: folder for folder in self._archive.runs()}
        if not folders:
            raise ArchiveError(f"{self.name} has no published run; survey into it first")
        called = next(reversed(folders)) if name == LATEST else name.removeprefix("runs/").rstrip("/")
        if called not in folders:
            known = ", ".join(list(folders)[-5:])
            raise NoRunError(f"{self.name} has no run {name!r}; its latest are {known}")
        return OpenedRun(self._archive, folders[called])

    def __iter__(self) -> Iterator[str]:
        return (folder.name for folder in reversed(self._archive.runs()))

    def __len__(self) -> int:
        return len(self._archive.runs())

    def __repr__(self) -> str:
        lines = [f"spectralzoom archive {self.name}, {len(self)} runs", *(f"  {name}" for name in self)]
        return "\n".join(lines)


class NoRunError(ArchiveError, KeyError):
    """An archive has no run of a name."""


class OpenedRun:
    """One published run. Arrays are read when they are used; see `OpenedArchive` for how to come by one.

    What lies on the scene's own grid (class map, confidence, mosaic, class probabilities) has the scene's CRS where it
    had one, and directions seen from the rig [rad] where it had none. A run with a ``[pose]`` has a ``ground_map``
    besides.
    """

    def __init__(self, archive: Archive, folder: Path) -> None:
        self._archive = archive
        self.folder = folder  # on this machine

    @property
    def name(self) -> str:
        """Its name in the archive: when its survey began, and of what field."""
        return self.folder.name

    @property
    def archive_name(self) -> str:
        """The address that opens its archive."""
        return self._archive.name

    @cached_property
    def receipt(self) -> Mapping[str, Any]:
        """Receipt of the run: settings, stages, savings, accuracy, products.

        Raises IncompleteStoreError: it is damaged.
        """
        found: Run = read_run(self.folder, {})
        if found.problem is not None:
            raise IncompleteStoreError(f"{found.uri} of {self._archive.name}: {found.problem}; run verify --repair")
        return found.receipt

    @property
    def report(self) -> Path:
        """The page for people: one file, opens in any browser."""
        return self._archive.locate(f"runs/{self.name}/report.html")

    @property
    def quicklook(self) -> Path:
        """Four panels in one picture."""
        return self._archive.locate(f"runs/{self.name}/quicklook.png")

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the numbers in its class map."""
        return tuple(self.dataset("class_map").attrs["class_names"])

    @property
    def class_map(self) -> xarray.DataArray:
        """(y, x) uint8 number of each pixel's class, 255 where there is none; names in ``flag_meanings``."""
        return self.dataset("class_map")["classes"]

    @property
    def confidence(self) -> xarray.DataArray:
        """(y, x) float32 probability of the class given, 0 to 1; NaN where there is none."""
        return self.dataset("class_map")["confidence"]

    @property
    def mosaic(self) -> xarray.DataArray:
        """(y, x, band) float32 values of the first pass, NaN where nothing was seen; indexed by ``wavelength`` too."""
        return spectra.open_lazy_mosaic(self._place("mosaic"))

    @property
    def cube(self) -> xarray.DataArray:
        """(y, x, band) float32 values in the finest pixels that were captured: those of the fine pass, if there is one.

        NaN where that pass saw nothing. Spectra are restored from their components when they are used.
        """
        name = "detail" if "detail" in self.receipt["products"] else "mosaic"
        return spectra.open_lazy_mosaic(self._place(name))

    @property
    def lines(self) -> dict[str, xarray.DataArray]:
        """Calibrated lines by the sweep's name: (line, sample, band) float32, NaN where a spectrum was unusable.

        They are restored from their components when they are used, with what was kept of rare spectra; time, mirror
        and exposure of each line are coordinates.
        """
        names = [name for name in LINE_PRODUCTS.values() if name in self.receipt["products"]]
        stores = [path for name in names for path in sorted(self._place(name).glob("*.zarr"))]
        return {path.stem: spectra.open_lazy_lines(path) for path in stores}

    @property
    def attention(self) -> xarray.Dataset:
        """Worth (``score``) and order (``rank``, -1 not looked at) of every patch, (patch_y, patch_x)."""
        return self.dataset("attention")

    @property
    def ground_map(self) -> xarray.Dataset:
        """All on the map, where the survey had a ``[pose]``; its CRS in ``spatial_ref``.

        ``classes``, ``confidence`` and ``picture``; ``age`` [days], and of a later visit ``changed`` (fraction of the
        patch) and ``changed_from`` (class before, 255 where it is the same).
        """
        return self.dataset("ground_map")

    @property
    def sweeps(self) -> dict[str, xarray.Dataset]:
        """Raw lines by the sweep's name: ``dn`` (line, sample, band), with time and mirror of each line.

        Raises IncompleteStoreError: they were cleared away, see ``keep`` in the settings; `lines` stay.
        """
        names = [name for name in LINE_PRODUCTS if name in self.receipt["products"]]
        for name in names:
            if not self._archive.is_there("/".join(self.receipt["products"][name].split("/")[:3])):
                raise IncompleteStoreError(
                    f"the raw lines of {self.name} were cleared away once they were condensed; `lines` has their"
                    " signal. A survey with keep = raw keeps raw lines"
                )
        folders = [self._place(name) for name in names]
        return {one.stem: open_labelled(one) for folder in folders for one in sorted(folder.glob("*.zarr"))}

    @property
    def products(self) -> tuple[str, ...]:
        """Names that `dataset` takes."""
        return tuple(name for name, where in self.receipt["products"].items() if where.endswith(".zarr"))

    def dataset(self, product: str) -> xarray.Dataset:
        """Open all arrays of a product, such as ``probabilities`` or ``geolocation``.

        Raises IncompleteStoreError: this run has left no such product, or it is damaged.
        """
        return open_labelled(self._place(product))

    def _place(self, product: str) -> Path:
        where = self.receipt["products"].get(product)
        if where is None:
            raise IncompleteStoreError(f"the run {self.name} left no {product}; it left {', '.join(self.products)}")
        return self._archive.locate(where)

    def __repr__(self) -> str:
        score = (self.receipt.get("accuracy") or {}).get("miou")
        known = "" if score is None else f", mIoU {100 * score:.1f}"
        return f"<run {self.name} of {self._archive.name}{known}>"


def open_labelled(path: Path) -> xarray.Dataset:
    """Open a store lazily, in dask's blocks of whole shards, with a coordinate on every axis.

    ``y`` and ``x`` are in metres where the store lies on a map (its CRS in ``spatial_ref``), else tangents of the angle
    from the undeflected direction [rad], else pixels; ``band`` and ``wavelength`` are in nm, both an index. Numbers are
    those of the store: no class becomes a float, whatever stands for none. Attributes are text, numbers or lists of
    them, and JSON text of what else a store has, so that ``to_netcdf`` and ``to_zarr`` write them. Raises
    IncompleteStoreError: there is no such store, or its metadata is damaged.
    """
    with damage_named(str(path)):
        opened = xarray.open_dataset(
            path, engine="zarr", consolidated=False, mask_and_scale=False, chunks=None, cache=False
        )
        opened = _in_shards(opened.drop_vars([name for name in PICTURES if name in opened]))
    bare = {name: np.arange(size) for name, size in opened.sizes.items() if name not in opened.variables}  # as rgb
    return spectra.by_wavelength(spectra.with_plain_attributes(opened.assign_coords(bare)))


def _in_shards(opened: xarray.Dataset) -> xarray.Dataset:
    """Arrays as dask's, in blocks of what is one file each; coordinates stay as they are."""

    def split(one: xarray.DataArray) -> xarray.DataArray:
        blocks = one.encoding.get("shards") or one.encoding.get("chunks") or one.shape
        return one.chunk(dict(zip(one.dims, blocks, strict=True)))

    return opened.assign({name: split(one) for name, one in opened.data_vars.items()})
