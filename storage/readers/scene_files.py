"""Scene files: an image or cube with its wavelengths and labels, as a survey takes it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.archive.staging import file_hash
from storage.readers.cube_sources import BLOCK_LINES, Bands, CubeSource, check_memory, scene_lines
from storage.readers.label_files import label_file
from storage.readers.labels import Labels, load_labels
from storage.readers.open_cubes import open_cube, split_variable
from storage.readers.polygons import is_polygon_file, load_polygon_labels
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings, settle_wavelengths
from storage.readers.scene_values import ValueCount, as_values, bands_text

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

ReadRows = Callable[[int, int], NDArray[np.float32]]


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """What a scene's file says beside its numbers."""

    name: str
    path: Path
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None  # (band,)
    labels: NDArray[np.uint8] | None  # (y, x) class index, 255 = unlabelled
    class_names: tuple[str, ...]
    class_colours: NDArray[np.uint8]  # (class, 3)
    class_values: tuple[ClassValue, ...]  # what each class is in the label file: a number or a colour
    content_hash: str  # of everything above, and of the values
    light_hash: str  # of values and wavelengths alone: labels do not change what a camera sees
    provenance: tuple[str, ...]  # one sentence for each thing assumed or left out
    geobox: GeoBox | None = None  # where the pixels lie on the earth
    labels_found: bool = False  # by the file's name: nobody stated them

    def without_labels(self, note: str) -> Self:
        """The same scene as if it had no labels; the note says why."""
        return replace(
            self,
            labels=None,
            class_names=(),
            class_colours=self.class_colours[:0],
            class_values=(),
            content_hash=self.light_hash,
            provenance=(*self.provenance, note),
        )

    def with_labels(self, labels: NDArray[np.uint8], note: str) -> Self:
        """The same scene with other labels; hash and provenance say so."""
        digest = _labelled_hash(self.light_hash, self.class_names, self.class_values, labels)
        return replace(self, labels=labels, content_hash=digest, provenance=(*self.provenance, note))


@dataclass(frozen=True, kw_only=True)
class SceneFile(SceneFacts):
    """A scene as its file gives it, on the file's own pixels."""

    values: NDArray[np.float32]  # (y, x, band), NaN where the file has none


@dataclass(frozen=True, kw_only=True)
class OpenScene(SceneFacts):
    """A scene file whose numbers are read some rows at a time, when they are asked for."""

    shape: tuple[int, int]  # (y, x)
    read: ReadRows  # from one row to before another: (y, x, band) float32, NaN where the file has no value
    missing: NDArray[np.bool_]  # (y, x) pixels without a value in more than half of their bands
    filled_px: int  # pixels without a value in a band


def load_scene_file(
    path: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
    classes: Mapping[str, ClassValue] | None = None,
    labels_needed: bool = True,
) -> SceneFile:
    """Read a scene from an image, .npy, .npz, .mat, ENVI, Zarr, NetCDF, HDF5, Sentinel-2 or a Headwall folder.

    ``path`` may be ``FILE.mat:VARIABLE`` or ``STORE.zarr:ARRAY``, and end in a step of time, ``FILE.npy:STEP``. Axes
    are y, x, band; two axes are one band. What comes in lines with dark and white frames is taken over the white reference.
    What is given here wins over the ``scene.toml`` beside the file, and that over what the file says: a file of class
    numbers or colours on the same pixels, or of polygons (others are found by their names), bands to use, counted from
    0, and wavelengths [nm], one for each band used or for each of the file. ``classes`` are those of a scene.toml that
    states none. Labels found by their names that cannot be used are left out with a note where no ``labels_needed``.
    Raises SceneError: a file is missing, damaged, of a kind or shape that cannot be used, or the labels do not fit.
    WavelengthError: wavelengths are missing, or their number, unit or range is wrong.
    """
    facts, _, values, _ = _open(path, labels, bands, wavelengths, classes or {}, labels_needed, keep=True)
    assert values is not None
    return SceneFile(values=values, **facts)


def open_scene_file(
    path: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
) -> OpenScene:
    """Open a scene as `load_scene_file` reads it, whose numbers are looked through once and not kept.

    GeoTIFF, ENVI, Zarr and .npy are read some rows at a time; images, .mat and .npz are whole in memory. Labels that
    were found by their names and cannot be used are left out with a note. Raises what `load_scene_file` does.
    """
    facts, read, _, count = _open(path, labels, bands, wavelengths, {}, False, keep=False)
    return OpenScene(shape=count.missing.shape, read=read, missing=count.missing, filled_px=count.filled_px, **facts)


def _open(
    address: str | Path,
    labels: str | Path | None,
    bands: Sequence[int] | None,
    wavelengths: Sequence[float] | None,
    classes: Mapping[str, ClassValue],
    labels_needed: bool,
    *,
    keep: bool,
) -> tuple[dict[str, Any], ReadRows, NDArray[np.float32] | None, ValueCount]:
    """Return the fields of `SceneFacts`, the reader of rows, all values where they are to be kept, and the counts."""
    file, variable = split_variable(address)
    source, settings = open_cube(address), find_scene_settings(file)
    height, width, count = source.shape
    calibrated = source.dark is not None and source.white is not None
    chosen, bad_note = _chosen_bands(bands, settings, count, file, source.bad_bands)
    _refuse_bands_first(file, source.shape, wavelengths or settings.wavelengths_nm)
    light = settle_wavelengths(file, chosen, count, stated=wavelengths, settings=settings, known=source.bands)
    nodata = settings.nodata if settings.nodata is not None or calibrated else source.nodata
    void = source.void
    gap_notes: tuple[str, ...] = ()
    if void is not None:
        gap_notes = (f"{int(void.sum())} transparent or masked pixels have no value, and no class in a map",)
        if void.all():
            void, gap_notes = None, ("every pixel is transparent or masked, which is not believed",)

    def rows(first: int, last: int) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        return scene_lines(source, first, last), None if void is None else void[first:last]

    def read(first: int, last: int) -> NDArray[np.float32]:
        """Give rows (y, x, band), NaN where the file has no value."""
        numbers, gaps = rows(first, last)
        return as_values(numbers, chosen, nodata, gaps)

    if keep:
        check_memory(address, 8 * height * width * count)  # as float32, and once more while the scene is made
    counted = ValueCount(file, chosen, nodata, (height, width))
    values = _count_values(counted, rows, np.empty((height, width, len(chosen)), np.float32) if keep else None)
    missing_notes = counted.notes()
    found, label_note, by_name = _labels_of(
        file, source.shape[:2], source.geobox, labels, settings, classes, labels_needed
    )
    light_hash = _light_hash(file, variable, source, chosen, light, settings.nodata, void)
    some = () if chosen == list(range(count)) else (f"bands {bands_text(chosen)} of {count}, counted from 0",)
    over = ("values are over the white reference",) if calibrated else ()
    of_labels: dict[str, Any] = {
        "labels": None if found is None else found.index,
        "class_names": () if found is None else found.names,
        "class_colours": np.zeros((0, 3), np.uint8) if found is None else found.colours,
        "class_values": () if found is None else found.values,
        "labels_found": by_name and found is not None,
    }
    labelled = light_hash if found is None else _labelled_hash(light_hash, found.names, found.values, found.index)
    facts = {
        "name": file.stem,
        "path": file,
        "wavelength_nm": light.wavelength_nm,
        "fwhm_nm": light.fwhm_nm,
        "content_hash": labelled,
        "light_hash": light_hash,
        "provenance": (*some, *bad_note, *source.notes, *over, light.origin, *gap_notes, *missing_notes, *label_note),
        "geobox": source.geobox,
        **of_labels,
    }
    return facts, read, values, counted


def _count_values(
    counted: ValueCount,
    rows: Callable[[int, int], tuple[NDArray[Any], NDArray[np.bool_] | None]],
    values: NDArray[np.float32] | None,
) -> NDArray[np.float32] | None:
    """Read all rows once, count what is missing, and fill ``values`` (y, x, band) where they are to be kept."""
    height = counted.missing.shape[0]
    for first in range(0, height, BLOCK_LINES):
        last = min(first + BLOCK_LINES, height)
        taken = counted.take(*rows(first, last))
        if values is not None:
            values[first:last] = taken
    return values


def _light_hash(
    file: Path,
    variable: str | None,
    source: CubeSource,
    chosen: list[int],
    light: Bands,
    nodata: float | None,
    void: NDArray[np.bool_] | None,
) -> str:
    """Return the hash of values and wavelengths: of the files, and of all that says what their numbers mean."""
    assert light.wavelength_nm is not None
    widths = None if light.fwhm_nm is None else light.fwhm_nm.tolist()
    stated: tuple[str, ...] = () if nodata is None else (f"nodata {nodata!r}",)
    stated += () if void is None else (f"void {hashlib.sha256(np.packbits(void).tobytes()).hexdigest()}",)
    stated += (source.scaling,) if source.scaling else ()
    content = _content_hash(file, source.files)
    return _digest(content, variable, chosen, light.wavelength_nm.tolist(), widths, *stated)


def _refuse_bands_first(path: Path, shape: tuple[int, ...], wavelengths: Sequence[float] | None) -> None:
    """Refuse a cube that has as many rows as there are wavelengths, and other bands (SceneError)."""
    count = 0 if wavelengths is None else len(wavelengths)
    if count > 1 and shape[0] == count != shape[2] and shape[1] != shape[2]:
        raise SceneError(
            f"{path} has the axes {shape}, read as (y, x, band), and there are {count} wavelengths: its bands come"
            " first; store it with the bands last, np.moveaxis(values, 0, -1)"
        )


def _content_hash(file: Path, files: tuple[Path, ...]) -> str:
    """Of all files that the numbers came from; within a folder their names count, too."""
    if files == (file,):
        return file_hash(file)
    within = [file.is_dir() and entry.is_relative_to(file) for entry in files]
    names = [entry.relative_to(file).as_posix() if inside else "" for entry, inside in zip(files, within, strict=True)]
    return _digest(*((name, file_hash(entry)) for name, entry in zip(names, files, strict=True)))


def _chosen_bands(
    bands: Sequence[int] | None, settings: SceneSettings, count: int, path: Path, bad: Sequence[int]
) -> tuple[list[int], tuple[str, ...]]:
    """Bands to use, and a note: without a word of the user's, those that the file itself does not call bad."""
    where = "--bands" if bands is not None else f"bands in {settings.path}"
    chosen = bands if bands is not None else settings.bands
    if chosen is None:
        good = [band for band in range(count) if band not in set(bad)]
        if len(good) == count or not good:
            return list(range(count)), ()
        everything = bands_text(range(count))
        left_out = f"bands {bands_text(sorted(bad))} are left out: the file calls them bad; --bands {everything} takes"
        return good, (f"{left_out} them all the same",)
    wrong = [band for band in chosen if not 0 <= band < count]
    if wrong or not chosen:
        raise SceneError(
            f"{where}: {f'band {wrong[0]}' if wrong else 'an empty list'}, but {path} has bands 0..{count - 1} "
            f"(counted from 0); correct it"
        )
    if len(set(chosen)) < len(chosen):
        raise SceneError(f"{where}: {list(chosen)} names a band twice; name each once")
    return [int(band) for band in chosen], ()


def _labels_of(
    scene: Path,
    shape: tuple[int, int],
    geobox: GeoBox | None,
    stated: str | Path | None,
    settings: SceneSettings,
    classes: Mapping[str, ClassValue],
    needed: bool,
) -> tuple[Labels | None, tuple[str, ...], bool]:
    """Return labels, a note of them, and whether their file was found by its name alone."""
    by_name = stated is None and settings.labels is None
    try:
        address, why_none = (stated, "") if stated is not None else label_file(scene, settings)
        if address is None:
            return None, (why_none,) if why_none else (), by_name
        stated_classes, notes = bool(settings.classes), tuple[str, ...]()
        known = settings.classes or classes
        if is_polygon_file(address):
            settings = settings.model_copy(update={"classes": dict(known)})
            found, notes = load_polygon_labels(address, shape, geobox, settings=settings)
        else:
            found = load_labels(address, shape, classes=known, unlabelled=settings.unlabelled)
    except SceneError as error:
        if needed or not by_name:
            raise
        return None, (f"the labels beside the scene are left out: {error}",), by_name
    how = f"classes from {settings.path}" if stated_classes else f"{len(found.names)} classes as found in the file"
    note = f"labels from {address}{', found by its name' if by_name else ''}, {how}"
    return found, (note, *notes, *_one_class_note(found)), by_name


def load_field_labels(address: str | Path, shape: tuple[int, int]) -> tuple[Labels, tuple[str, ...]]:
    """Read labels on a field's (y, x) pixels, with the classes of a scene.toml beside them; and notes.

    Raises SceneError: they cannot be read, or do not fit.
    """
    file, _ = split_variable(address)
    found, notes, _ = _labels_of(file, shape, None, address, find_scene_settings(file), {}, True)
    assert found is not None
    return found, notes


def _one_class_note(found: Labels) -> tuple[str, ...]:
    """Question labels that are all alike: the one value may stand for what nobody has labelled."""
    there = np.unique(found.index[found.index != UNLABELLED])
    if len(there) != 1:
        return ()
    name, value = found.names[there[0]], found.values[there[0]]
    told = value if isinstance(value, int) else list(value)
    return (
        f"all labels are {name}: if {told} in the label file stands for no class, write unlabelled = {told} into a"
        f" {SETTINGS_NAME}",
    )


def _labelled_hash(
    light_hash: str, names: Sequence[str], values: Sequence[ClassValue], index: NDArray[np.uint8]
) -> str:
    return _digest(light_hash, names, values, hashlib.sha256(np.ascontiguousarray(index).tobytes()).hexdigest())


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
