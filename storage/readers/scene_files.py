"""Scene files: an image or cube with its wavelengths and labels, as a survey takes it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import EmptySceneError, SceneError
from pipeline.geometry.grid import UNLABELLED
from pipeline.readings import MOST_VALUE, beyond_range, find_beyond
from storage.archive.staging import file_hash
from storage.readers.cube_sources import BLOCK_LINES, Bands, CubeSource, check_memory, scene_lines, unpacked
from storage.readers.label_files import label_file
from storage.readers.labels import Labels, load_labels
from storage.readers.open_cubes import open_cube, split_variable
from storage.readers.polygons import is_polygon_file, load_polygon_labels
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings, settle_wavelengths

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

ReadRows = Callable[[int, int], NDArray[np.float32]]
USUAL_NODATA = -9999.0  # what programs write for no data, and no sensor reads


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """A scene as its file gives it, on the file's own pixels; its numbers are read when they are asked for."""

    name: str
    path: Path
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None  # (band,)
    shape: tuple[int, int]  # (y, x)
    read: ReadRows  # from one row to before another: (y, x, band) float32, NaN where the file has no value
    missing: NDArray[np.bool_]  # (y, x) pixels without a value in more than half of their bands
    filled_px: int  # pixels without a value in a band
    light_hash: str  # of values and wavelengths alone: labels do not change what a camera sees
    content: tuple[str, ...]  # hash of what it was read from, in whatever bands; one for each tile
    provenance: tuple[str, ...]  # one sentence for each thing assumed or left out
    labels: NDArray[np.uint8] | None = None  # (y, x) class index, 255 = unlabelled
    class_names: tuple[str, ...] = ()
    class_values: tuple[ClassValue, ...] = ()  # what each class is in the label file: a number or a colour
    class_colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))  # (class, 3)
    geobox: GeoBox | None = None  # where the pixels lie on the earth
    pixel_m: float | None = None  # side of a pixel on the ground, as scene.toml says, of a scene without a place
    labels_found: bool = False  # by the file's name: no setting names them
    regridded: bool = False  # labels came on another grid and were brought to the scene's
    kept: NDArray[np.float32] | None = field(default=None, repr=False)  # all values, where they were kept

    @property
    def values(self) -> NDArray[np.float32]:
        """Return all values, (y, x, band), NaN where the file has none."""
        return self.read(0, self.shape[0]) if self.kept is None else self.kept

    def labelled(self, found: Labels | None, *, by_name: bool) -> SceneFile:
        """Return the scene with labels and their classes."""
        if found is None:
            return self
        return replace(
            self,
            labels=found.index,
            class_names=found.names,
            class_values=found.values,
            class_colours=found.colours,
            labels_found=by_name,
            regridded=found.regridded,
        )


def load_scene_file(
    path: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
    classes: Mapping[str, ClassValue] | None = None,
    labels_needed: bool = True,
) -> SceneFile:
    """Read a scene from an image, .npy, .npz, .mat, ENVI, Zarr, NetCDF, HDF5 or a Headwall folder.

    ``path`` may be ``FILE.mat:ARRAY`` or ``STORE.zarr:ARRAY``, and end in a step of time, ``FILE.npy:STEP``. Axes are
    y, x, band; two axes are one band. Lines with dark and white frames are taken over the white reference. Arguments
    win over the ``scene.toml`` beside the file, and that over the file itself. ``labels`` is a file of class numbers or
    colours on the same pixels, or of polygons; others are found by their names. ``bands`` count from 0; ``wavelengths``
    [nm] are one for each band used or for each of the file. ``classes`` are those of a scene.toml that states none.
    Labels found by their names that cannot be used are left out with a note where no ``labels_needed``. Raises
    SceneError: a file is missing, damaged, of a kind or shape that cannot be used, or the labels do not fit.
    WavelengthError: wavelengths are missing, or their number, unit or range is wrong.
    """
    return open_scene_file(
        path,
        labels=labels,
        bands=bands,
        wavelengths=wavelengths,
        classes=classes,
        labels_needed=labels_needed,
        keep=True,
    )


def open_scene_file(
    address: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
    classes: Mapping[str, ClassValue] | None = None,
    labels_needed: bool = False,
    keep: bool = False,
) -> SceneFile:
    """Open a scene as `load_scene_file` reads it, whose numbers are looked through once and not kept.

    GeoTIFF, ENVI, Zarr and .npy are read some rows at a time; images, .mat and .npz are whole in memory. Labels that
    were found by their names and cannot be used are left out with a note. Raises what `load_scene_file` does.
    """
    file, variable = split_variable(address)
    source, settings = open_cube(address), find_scene_settings(file)
    height, width, count = source.shape
    chosen, bad_note = _chosen_bands(bands, settings, count, file, source.bad_bands)
    _refuse_bands_first(file, source.shape, wavelengths or settings.wavelengths_nm)
    light = settle_wavelengths(file, chosen, count, stated=wavelengths, settings=settings, known=source.bands)
    assert light.wavelength_nm is not None
    values = FileValues.of(source, chosen, settings)
    if keep:
        check_memory(address, 8 * height * width * count)  # as float32, and once more while the scene is made
    kept = np.empty((height, width, len(chosen)), np.float32) if keep else None
    gaps = _find_gaps(file, values, kept)
    found, label_note, by_name = _labels_of(
        file, source.shape[:2], source.geobox, labels, settings, classes or {}, labels_needed
    )
    content = _content_hash(file, source.files)
    some = () if chosen == list(range(count)) else (f"bands {bands_text(chosen)} of {count}, counted from 0",)
    how, of_mask = values.notes(settings.path)
    scene = SceneFile(
        name=file.stem,
        path=file,
        wavelength_nm=light.wavelength_nm,
        fwhm_nm=light.fwhm_nm,
        shape=(height, width),
        read=values.read,
        missing=gaps.missing,
        filled_px=gaps.filled_px,
        light_hash=_light_hash(content, variable, values, light, used=gaps.void > 0, stated=settings.nodata),
        content=(content if variable is None else _digest(content, variable),),
        provenance=(*some, *bad_note, *source.notes, *how, light.origin, *of_mask, *gaps.notes, *label_note),
        geobox=source.geobox,
        pixel_m=None if source.geobox is not None else settings.pixel_m,
        kept=kept,
    )
    return scene.labelled(found, by_name=by_name)


def _stated_scaling(scale: float, offset: float) -> str:
    """Return scene.toml's scaling of the numbers, for hashes; empty where there is none."""
    return "" if (scale, offset) == (1.0, 0.0) else f"{SETTINGS_NAME} scale {scale!r} offset {offset!r}"


def with_stated_values(source: CubeSource, address: str | Path) -> CubeSource:
    """Return a cube whose numbers are what the ``scene.toml`` beside it says: no data, scale and offset.

    Scaled numbers are float32, NaN where there is no data, as a survey of the file has them. Raises SceneError: a scale
    is stated for numbers that have dark or white frames.
    """
    settings = find_scene_settings(split_variable(address)[0])
    scaling = _stated_scaling(settings.scale, settings.offset)
    stated = () if settings.nodata is None else (f"{SETTINGS_NAME} nodata {settings.nodata!r}",)
    nodata = source.nodata if settings.nodata is None else settings.nodata
    source = replace(source, nodata=nodata, scaling=" ".join(filter(None, (source.scaling, *stated, scaling))))
    if not scaling:
        return source
    if source.dark is not None or source.white is not None:
        raise SceneError(
            f"{settings.path} has a scale or offset, and {address} dark or white frames: a camera's own numbers are "
            "stored as they are; take scale and offset out of it, and state them where values are made of the numbers"
        )
    note = f"values are the file's times {settings.scale:g} plus {settings.offset:g}, as {SETTINGS_NAME} says"
    nodata, plain = USUAL_NODATA if nodata is None and source.dtype.kind in "if" else nodata, source.read

    def read(start: int, stop: int) -> NDArray[np.float32]:
        """Return some lines (line, sample, band), NaN where the file has no value."""
        return unpacked(plain(start, stop), settings.scale, settings.offset, nodata)

    return replace(source, read=read, dtype=np.dtype(np.float32), nodata=None, notes=(*source.notes, note))


def _light_hash(
    content: str, variable: str | None, values: FileValues, light: Bands, *, used: bool, stated: float | None
) -> str:
    """Return the hash of values and wavelengths: of the files, and of all that says what their numbers mean.

    An assumed no-data value counts where it is ``used``, else the ``stated`` one.
    """
    assert light.wavelength_nm is not None
    widths = None if light.fwhm_nm is None else light.fwhm_nm.tolist()
    nodata, void = values.nodata if values.assumed and used else stated, values.void
    said: tuple[str, ...] = () if nodata is None else (f"nodata {nodata!r}",)
    said += () if void is None else (f"void {hashlib.sha256(np.packbits(void).tobytes()).hexdigest()}",)
    said += tuple(one for one in (values.source.scaling, values.scaling) if one)
    return _digest(content, variable, values.bands, light.wavelength_nm.tolist(), widths, *said)


def _refuse_bands_first(path: Path, shape: tuple[int, ...], wavelengths: Sequence[float] | None) -> None:
    """Refuse a cube that has as many rows as there are wavelengths, and other bands (SceneError)."""
    count = 0 if wavelengths is None else len(wavelengths)
    if count > 1 and shape[0] == count != shape[2] and shape[1] != shape[2]:
        raise SceneError(
            f"{path} has the axes {shape}, read as (y, x, band), and there are {count} wavelengths: its bands come"
            " first; store it with the bands last, np.moveaxis(values, 0, -1)"
        )


def _content_hash(file: Path, files: tuple[Path, ...]) -> str:
    """Return the hash of all files that the numbers came from; within a folder their names count, too."""
    if files == (file,):
        return file_hash(file)
    within = [file.is_dir() and entry.is_relative_to(file) for entry in files]
    names = [entry.relative_to(file).as_posix() if inside else "" for entry, inside in zip(files, within, strict=True)]
    return _digest(*((name, file_hash(entry)) for name, entry in zip(names, files, strict=True)))


def _chosen_bands(
    bands: Sequence[int] | None, settings: SceneSettings, count: int, path: Path, bad: Sequence[int]
) -> tuple[list[int], tuple[str, ...]]:
    """Return the bands to use, and a note; without a choice by the user, all that the file does not call bad."""
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
            found = load_labels(
                address, shape, geobox, classes=known, unlabelled=settings.unlabelled, colours=settings.colours
            )
            notes = found.notes
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
    """Return a question on labels that are all alike: the one value may mean unlabelled. Empty otherwise."""
    there = np.unique(found.index[found.index != UNLABELLED])
    if len(there) != 1:
        return ()
    name, value = found.names[there[0]], found.values[there[0]]
    told = value if isinstance(value, int) else list(value)
    return (
        f"all labels are {name}: if {told} in the label file stands for no class, write unlabelled = {told} into a"
        f" {SETTINGS_NAME}",
    )


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


# --- values -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FileValues:
    """The numbers of a file in the chosen bands as the values of a scene, NaN where there is none."""

    source: CubeSource
    bands: list[int]
    nodata: float | None
    assumed: bool  # nothing states the no-data value
    void: NDArray[np.bool_] | None  # (y, x) transparent or masked
    scale: float  # of scene.toml
    offset: float

    @classmethod
    def of(cls, source: CubeSource, bands: list[int], settings: SceneSettings) -> FileValues:
        """Take the no-data value of scene.toml, of the file, or the usual one; a mask of everything does not count."""
        calibrated = source.dark is not None and source.white is not None
        nodata = settings.nodata if settings.nodata is not None or calibrated else source.nodata
        assumed = nodata is None and not calibrated and source.dtype.kind in "if"
        void = None if source.void is None or source.void.all() else source.void
        return cls(source, bands, USUAL_NODATA if assumed else nodata, assumed, void, settings.scale, settings.offset)

    @property
    def scaling(self) -> str:
        """Return scene.toml's scaling of the numbers, for hashes."""
        return _stated_scaling(self.scale, self.offset)

    def notes(self, settings: Path | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return sentences on what is done to the numbers, by the scene.toml ``settings``; and on gaps."""
        how, void = list[str](), self.source.void
        if self.source.dark is not None and self.source.white is not None:
            how.append("values are over the white reference")
        if self.scaling:
            how.append(f"values are the file's times {self.scale:g} plus {self.offset:g}, as {settings} says")
        if void is None:
            return tuple(how), ()
        if self.void is None:
            return tuple(how), ("every pixel is transparent or masked: the mask is left out",)
        return tuple(how), (f"{int(void.sum())} transparent or masked pixels have no value, and no class in a map",)

    def converted(self, first: int, stop: int) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_] | None]:
        """Return rows in the file's numbers and as float32 with NaN, (y, x, band), and which of them are no data."""
        rows = scene_lines(self.source, first, stop)
        picked = rows if self.bands == list(range(rows.shape[2])) else rows[..., self.bands]
        with np.errstate(over="ignore"):
            values = np.array(picked, np.float32, order="C")
        if self.nodata is None:
            return picked, values, None
        # Compared as numbers: -9999 in the numbers of the file would wrap to 55537 where they are uint16.
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


@dataclass(frozen=True)
class Gaps:
    """Values missing among the values of a file."""

    missing: NDArray[np.bool_]  # (y, x) pixels without a value in more than half of their bands
    filled_px: int  # pixels without a value in a band
    void: int  # samples that have the no-data value
    notes: tuple[str, ...]  # a sentence for each thing that is missing


def _find_gaps(path: Path, values: FileValues, kept: NDArray[np.float32] | None) -> Gaps:
    """Look through all values of a file once, and keep them in ``kept`` where it is given.

    Raises SceneError: a value is no reading, a band has no value anywhere, or no value is finite.
    """
    height, width, _ = values.source.shape
    chosen, nodata, notes = values.bands, values.nodata, list[str]()
    missing, seen = np.zeros((height, width), np.bool_), np.zeros(len(chosen), np.bool_)
    filled_px = void = infinite = absent = 0
    for first in range(0, height, BLOCK_LINES):
        rows = slice(first, min(first + BLOCK_LINES, height))
        picked, block, empty = values.converted(rows.start, rows.stop)
        void += 0 if empty is None else int(np.count_nonzero(empty))
        if beyond_range(picked) is not None:
            found = find_beyond(picked if empty is None else np.where(empty, picked.dtype.type(0), picked))
            if found is not None:
                y, x, band = found.place
                raise SceneError(
                    f"{path} has {found.value!s} at y {first + y}, x {x}, band {chosen[band]}, beyond the"
                    f" {MOST_VALUE:g} that readings reach; if it stands for no data, write nodata = {found.value!s}"
                    f" into a {SETTINGS_NAME} beside the file, else leave the band out with --bands, or give the values"
                    " in a larger unit"
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
    if nodata is not None and not values.assumed:
        notes.append(f"{void} samples have the file's no-data value {nodata:g}")
    elif void:
        notes.append(
            f"{void} samples are {nodata:g}, which is taken for no data though nothing says so; where it"
            f" is a reading, state another number as nodata in a {SETTINGS_NAME}"
        )
    if infinite:
        notes.append(f"{infinite} infinite samples count as missing")
    if not seen.any():
        raise EmptySceneError(f"{path} holds no finite number in the bands used; choose others")
    if not seen.all():
        without, rest = (
            bands_text([band for band, there in zip(chosen, seen, strict=True) if there == wanted])
            for wanted in (False, True)
        )
        raise SceneError(f"{path} has no value anywhere in bands {without} (from 0); take the others: --bands {rest}")
    if absent:
        notes.append(f"{absent} of {missing.size * len(chosen)} samples are missing")
    return Gaps(missing, filled_px, void, tuple(notes))


def bands_text(bands: Sequence[int]) -> str:
    """Return the band numbers as ``--bands`` takes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for band in bands:
        if runs and band == runs[-1][1] + 1:
            runs[-1][1] = band
        else:
            runs.append([band, band])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)
