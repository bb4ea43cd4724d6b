"""Open an image or cube with its wavelengths and labels as a scene."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import EmptySceneError, SceneError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.readings import MOST_VALUE, beyond_range, find_beyond
from spectralzoom.pipeline.signal.line_faults import CURE, DARK_LINE, counted, leave_out
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers.band_facts import Bands, bands_text
from spectralzoom.storage.readers.cube_sources import (
    BLOCK_LINES,
    CubeSource,
    check_memory,
    dark_lines,
    scene_lines,
    unpacked,
)
from spectralzoom.storage.readers.label_files import label_file, read_labels
from spectralzoom.storage.readers.labels import Labels
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_toml import (
    SETTINGS_NAME,
    ClassValue,
    SceneSettings,
    find_scene_settings,
    settle_wavelengths,
)
from spectralzoom.storage.readers.user_files import reading_files

USUAL_NODATA = -9999.0  # assumed where no file states another
FOUND = f'; they were found by their name: labels = "" in a {SETTINGS_NAME} beside the scene leaves them out'


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """A scene on the pixels of its file; values are read on demand."""

    name: str
    path: Path
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None  # (band,)
    shape: tuple[int, int]  # (y, x)
    read: Callable[[int, int], NDArray[np.float32]]  # rows from one to another: (y, x, band), NaN without a value
    missing: NDArray[np.bool_]  # (y, x) pixels without a value in more than half of their bands
    filled_px: int  # pixels without a value in a band
    light_hash: str  # of values and wavelengths, without labels
    content: tuple[str, ...]  # hashes of the files, one for each tile
    provenance: tuple[str, ...]  # one sentence for each assumption or omission
    labels: NDArray[np.uint8] | None = None  # (y, x) class index, 255 = unlabelled
    class_names: tuple[str, ...] = ()
    class_values: tuple[ClassValue, ...] = ()  # number or colour of each class in the label file
    class_colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))  # (class, 3)
    geobox: GeoBox | None = None  # where the pixels lie on the earth
    pixel_m: float | None = None  # side of a pixel on the ground, by scene.toml, if there is no geobox
    acquired: str | None = None  # when the light was captured: a day or a moment in UTC, ISO 8601
    regridded: bool = False  # labels were resampled from another grid
    kept: NDArray[np.float32] | None = field(default=None, repr=False)  # all values, if they were kept in memory

    @property
    def values(self) -> NDArray[np.float32]:
        """Return all values (y, x, band), NaN where the file has none."""
        return self.read(0, self.shape[0]) if self.kept is None else self.kept


@reading_files()
def open_scene_file(
    address: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
    classes: Mapping[str, ClassValue] | None = None,
    keep: bool = False,
) -> SceneFile:
    """Open a scene from an image, .npy, .mat, ENVI, Zarr, NetCDF, HDF5 or a Headwall folder.

    ``address`` may be ``FILE.mat:ARRAY`` or ``STORE.zarr:ARRAY``. Axes are y, x, band; two axes are one band. All
    values are read once for gaps; only with ``keep``, and of images and .mat, they stay in memory. Arguments take
    precedence over the ``scene.toml`` beside the file, and that over the file. ``labels`` are class numbers or colours
    on the same pixels, or polygons; others are found by their names. ``bands`` count from 0; ``wavelengths`` [nm] are
    one for each band used or for each of the file. ``classes`` replace those of a scene.toml that has none. Raises
    SceneError: a file is missing, damaged, or of a kind or shape that cannot be used, or the labels do not fit;
    WavelengthError: wavelengths are missing, or their number, unit or range is wrong.
    """
    file, variable = split_variable(address)
    source = open_cube_source(address)
    settings = find_scene_settings(file)
    height, width, count = source.shape
    stated = wavelengths is not None or settings.wavelengths_nm is not None or settings.wavelengths_file is not None
    known = [band for band in range(count) if stated or band not in source.bands.unknown]
    chosen, bad_note = _chosen_bands(bands, settings, count, file, source.bad_bands, known)
    light = settle_wavelengths(
        file, chosen, count, stated=wavelengths, settings=settings, known=source.bands, shape=source.shape
    )
    assert light.wavelength_nm is not None
    values = FileValues.of(source, chosen, settings)
    if keep:
        check_memory(address, 8 * height * width * count)  # as float32, and once more while the scene is made
    kept = np.empty((height, width, len(chosen)), np.float32) if keep else None
    missing, filled_px, void, gaps = _find_gaps(file, values, kept)
    found, label_note = _labels_of(file, source, labels, settings, classes or {})
    content = _content_hash(file, source)
    some = () if chosen == list(range(count)) else (f"bands {bands_text(chosen)} of {count}, counted from 0",)
    scene = SceneFile(
        name=file.stem,
        path=file,
        wavelength_nm=light.wavelength_nm,
        fwhm_nm=light.fwhm_nm,
        shape=(height, width),
        read=values.read,
        missing=missing,
        filled_px=filled_px,
        light_hash=_light_hash(content, variable, values, light, used=void > 0, stated=settings.nodata),
        content=(content if variable is None else _digest(content, variable),),
        provenance=(*some, *bad_note, *source.notes, *values.notes(settings.path), light.origin, *gaps, *label_note),
        geobox=source.geobox,
        pixel_m=None if source.geobox is not None else settings.pixel_m,
        acquired=source.acquired,
        kept=kept,
    )
    if found is None:
        return scene
    return replace(
        scene,
        labels=found.index,
        class_names=found.names,
        class_values=found.values,
        class_colours=found.colours,
        regridded=found.regridded,
    )


# As `open_scene_file`, with all values in memory.
load_scene_file = partial(open_scene_file, keep=True)


def _light_hash(
    content: str, variable: str | None, values: FileValues, light: Bands, *, used: bool, stated: float | None
) -> str:
    """Return the hash of the files and of bands, wavelengths, scale, mask and no-data value.

    An assumed no-data value counts if it is ``used``, else the ``stated`` one.
    """
    assert light.wavelength_nm is not None
    widths = None if light.fwhm_nm is None else light.fwhm_nm.tolist()
    nodata = values.nodata if values.assumed and used else stated
    more = [] if nodata is None else [f"nodata {nodata!r}"]
    void = values.source.void
    more += [] if void is None else [f"void {hashlib.sha256(np.packbits(void).tobytes()).hexdigest()}"]
    more += [one for one in (values.source.scaling, values.scaling) if one]
    return _digest(content, variable, values.bands, light.wavelength_nm.tolist(), widths, *more)


def _content_hash(file: Path, source: CubeSource) -> str:
    """Return the hash of all files, and of their names within a folder."""
    if source.files == (file,):
        return source.opened.digest(file)
    names = [entry.relative_to(file).as_posix() if file in entry.parents else "" for entry in source.files]
    return _digest(*zip(names, map(source.opened.digest, source.files), strict=True))


def _chosen_bands(
    bands: Sequence[int] | None,
    settings: SceneSettings,
    count: int,
    path: Path,
    bad: Sequence[int],
    known: Sequence[int],
) -> tuple[list[int], tuple[str, ...]]:
    """Return the chosen bands, else those of known wavelength that the file does not mark as bad, and a note."""
    where = "--bands" if bands is not None else f"bands in {settings.path}"
    chosen = bands if bands is not None else settings.bands
    if chosen is None:
        good = [band for band in known if band not in set(bad)]
        if not bad or not good:
            return list(known), ("every band is marked as bad: the marks are ignored",) if bad else ()
        everything, left_out = bands_text(known), bands_text(sorted(bad))
        return good, (f"bands {left_out} are left out: the file marks them as bad; --bands {everything} takes all",)
    wrong = [band for band in chosen if not 0 <= band < count]
    if wrong or not chosen:
        raise SceneError(
            f"{where}: {f'band {wrong[0]}' if wrong else 'an empty list'}, but {path} has bands 0..{count - 1} "
            f"(counted from 0); correct it"
        )
    if twice := sorted(band for band, times in Counter(chosen).items() if times > 1):
        raise SceneError(f"{where} names bands {bands_text(twice)} twice; name each once")
    return [int(band) for band in chosen], ()


def _labels_of(
    scene: Path,
    source: CubeSource,
    stated: str | Path | None,
    settings: SceneSettings,
    classes: Mapping[str, ClassValue],
) -> tuple[Labels | None, tuple[str, ...]]:
    """Return labels and notes on them (SceneError: they do not fit)."""
    by_name = stated is None and settings.labels is None
    address, why_none = (stated, "") if stated is not None else label_file(scene, settings)
    if address is None:
        return None, (why_none,) if why_none else ()
    known = settings if settings.classes else settings.model_copy(update={"classes": dict(classes)})
    try:
        found = read_labels(address, source.shape[:2], source.geobox, known)
    except SceneError as error:
        turned = "".join(f"; {note}" for note in source.notes if "orientation tag" in note)
        raise SceneError(f"{error}{turned}{FOUND if by_name else ''}") from error
    first = f"{_read_from(address, found, settings)}{', found by its name' if by_name else ''}"
    return found, (first, *found.notes)


def _read_from(address: str | Path, found: Labels, settings: SceneSettings) -> str:
    """Return where labels and their classes come from."""
    how = f"classes from {settings.path}" if settings.classes else f"{len(found.names)} classes as found in the file"
    return f"labels from {address}, {how}"


@reading_files()
def load_field_labels(address: str | Path, shape: tuple[int, int]) -> tuple[Labels, tuple[str, ...]]:
    """Read labels on a field's (y, x) pixels, with the classes of a scene.toml beside them; and notes (SceneError)."""
    settings = find_scene_settings(split_variable(address)[0])
    found = read_labels(address, shape, None, settings)
    return found, (_read_from(address, found, settings), *found.notes)


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class FileValues:
    """The numbers of a file in the chosen bands as the values of a scene, NaN without one."""

    source: CubeSource
    bands: list[int]
    nodata: float | None
    assumed: bool  # nothing states the no-data value
    scale: float  # of scene.toml
    offset: float

    @classmethod
    def of(cls, source: CubeSource, bands: list[int], settings: SceneSettings) -> FileValues:
        """Use the no-data value of scene.toml, of the file, or the usual one."""
        calibrated = source.dark is not None and source.white is not None
        nodata = settings.nodata if settings.nodata is not None or calibrated else source.nodata
        assumed = nodata is None and not calibrated and source.dtype.kind in "if"
        return cls(source, bands, USUAL_NODATA if assumed else nodata, assumed, settings.scale, settings.offset)

    @property
    def scaling(self) -> str:
        """Return scene.toml's scaling as a text for hashes; empty without one."""
        plain = (self.scale, self.offset) == (1.0, 0.0)
        return "" if plain else f"{SETTINGS_NAME} scale {self.scale!r} offset {self.offset!r}"

    def notes(self, settings: Path | None) -> list[str]:
        """Return notes on the scaling, by the scene.toml ``settings``, and on the mask."""
        notes: list[str] = []
        if self.source.dark is not None and self.source.white is not None:
            notes.append("values are over the white reference")
        if self.scaling:
            notes.append(f"values are the file's times {self.scale:g} plus {self.offset:g}, as {settings} says")
        if self.source.void is not None:
            notes.append(f"{self.source.void.sum()} transparent or masked pixels have no value, and no class in a map")
        return notes

    def converted(self, first: int, stop: int) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_] | None]:
        """Return rows (y, x, band) as the file's numbers and as float32 with NaN, and which of them are no data."""
        rows = scene_lines(self.source, first, stop)
        picked = rows if self.bands == list(range(rows.shape[2])) else rows[..., self.bands]
        with np.errstate(over="ignore"):
            values = np.array(picked, np.float32, order="C")
        if self.nodata is None:
            return picked, values, None
        # compared as numbers: -9999 as uint16 would be 55537
        with np.errstate(over="ignore"):
            empty = np.asarray(picked == self.nodata if np.isfinite(self.nodata) else np.isnan(values), np.bool_)
        values[empty] = np.nan
        return picked, values, empty

    def scaled(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values as scene.toml scales them."""
        return unpacked(values, self.scale, self.offset, None) if self.scaling else values

    def read(self, first: int, stop: int) -> NDArray[np.float32]:
        """Return rows (y, x, band), NaN where the file has no value."""
        _, values, _ = self.converted(first, stop)
        values[np.isinf(values)] = np.nan
        return self.scaled(values)


def _find_gaps(
    path: Path, values: FileValues, kept: NDArray[np.float32] | None
) -> tuple[NDArray[np.bool_], int, int, tuple[str, ...]]:
    """Read all values once, and store them in ``kept`` if it is given.

    Returns (y, x) pixels without a value in most bands, and notes. The counts between them are of pixels without a
    value in a band, and of no-data samples. Raises SceneError: a value is out of range, a band has no value, or no
    value is finite.
    """
    height, width, _ = values.source.shape
    chosen = values.bands
    missing = np.zeros((height, width), np.bool_)
    seen = np.zeros(len(chosen), np.bool_)
    filled_px = void = infinite = absent = after_scale = 0
    source, dark = values.source, np.zeros(height, np.bool_)
    for rows in cuts(height, BLOCK_LINES):
        picked, block, empty = values.converted(rows.start, rows.stop)
        if source.dark is not None:
            dark[rows] = dark_lines(source, source.read(rows.start, rows.stop))
        void += 0 if empty is None else int(np.count_nonzero(empty))
        if (packed := values.source.packed_nodata) is not None:
            after_scale += int(np.count_nonzero(np.isclose(block, packed, rtol=1e-6, atol=0)))
        if beyond_range(picked) is not None:
            found = find_beyond(picked if empty is None else np.where(empty, picked.dtype.type(0), picked))
            if found is not None:
                y, x, band = found.place
                raise SceneError(
                    f"{path} has {found.value!s} at y {rows.start + y}, x {x}, band {chosen[band]}, above the limit of"
                    f" {MOST_VALUE:g}; if it means no data, write nodata = {found.value!s} into a {SETTINGS_NAME}"
                    " beside the file, else leave the band out with --bands, or give the values in a larger unit"
                )
            infinite += int(np.count_nonzero(np.isinf(block)))
            block[np.isinf(block)] = np.nan
        known = np.isfinite(block)
        count = known.sum(axis=2)
        absent += block.size - int(count.sum())
        missing[rows] = 2 * count < len(chosen)
        filled_px += int(np.count_nonzero(count < len(chosen)))
        seen |= known.any(axis=(0, 1))
        if kept is not None:
            kept[rows] = values.scaled(block)
    _, notes = leave_out(source.name, source.valid, counted([(DARK_LINE, dark)]), CURE)
    if void and not values.assumed:
        notes.append(f"{void} samples have the file's no-data value {values.nodata:g}")
    elif void:
        notes.append(
            f"{void} samples are {values.nodata:g}, which is taken for no data; if it is a value, state another number"
            f" as nodata in a {SETTINGS_NAME}"
        )
    if after_scale and not absent:
        notes.append(
            f"no sample has the file's no-data value {packed:g} before scaling, and {after_scale} have it after; if"
            f" these are no data, write nodata = {packed:g} into a {SETTINGS_NAME}"
        )
    if infinite:
        notes.append(f"{infinite} infinite samples count as missing")
    if not seen.any():
        raise EmptySceneError(f"{path} holds no finite number in the bands used; choose others")
    if not seen.all():
        without, rest = (bands_text(np.array(chosen)[one].tolist()) for one in (~seen, seen))
        raise SceneError(
            f'{path} has no value anywhere in bands {without} (from 0); take the others: bands = "{rest}" in a'
            f" {SETTINGS_NAME} beside it, or survey --bands {rest}"
        )
    if absent:
        notes.append(f"missing samples: {absent} of {missing.size * len(chosen)}")
    return missing, filled_px, void, tuple(notes)


def empty_bands(source: CubeSource, settings: SceneSettings) -> tuple[int, ...]:
    """Return the bands (from 0) without a value anywhere; reading ends where each band has had one (SceneError)."""
    height, _, count = source.shape
    values = FileValues.of(source, list(range(count)), settings)
    empty = np.ones(count, np.bool_)
    for rows in cuts(height, BLOCK_LINES):
        if not empty.any():
            break
        empty &= ~np.isfinite(values.converted(rows.start, rows.stop)[1]).any(axis=(0, 1))
    return tuple(np.flatnonzero(empty).tolist())
