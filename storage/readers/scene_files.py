"""Scene files: an image or cube with its wavelengths and labels, as a simulated rig looks at it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.archive.staging import file_hash
from storage.readers.cube_sources import BLOCK_LINES
from storage.readers.label_files import find_label
from storage.readers.labels import Labels, Layout, load_frame_or_raster, load_labels
from storage.readers.polygon_labels import is_polygon_file, load_polygon_labels
from storage.readers.raster_files import split_variable
from storage.readers.scan_files import reader_of
from storage.readers.scene_rows import SceneRows, ValueCount, as_values, bands_text, load_scan, open_rows
from storage.readers.scene_toml import (
    SETTINGS_NAME,
    BandWavelengths,
    ClassValue,
    SceneSettings,
    find_scene_settings,
    settle_wavelengths,
)
from storage.readers.zone_files import split_layer

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
    are y, x, band; two axes are one band. What comes in lines with dark and white frames is taken over the white panel.
    What is given here wins over the ``scene.toml`` beside the file, and that over what the file says: a file of class
    numbers or colours on the same pixels, or of polygons (frames of HyKo2 and RANUS bring their own, others are found
    by their names), bands to use, counted from 0, and wavelengths [nm], one for each band used or for each of the file.
    ``classes`` are those of a scene.toml that states none. Labels found by their names that cannot be used are left out
    with a note where no ``labels_needed``. Raises SceneError: a file is missing, damaged, of a kind or shape that
    cannot be used, or the labels do not fit. WavelengthError: wavelengths are missing, or their number, unit or range
    is wrong.
    """
    file, variable = split_variable(path)
    raster, layout = load_frame_or_raster(path) if reader_of(path) == "raster" else (load_scan(path), None)
    cube = raster.three_axes(file)
    rows = SceneRows.of(raster, cube)
    stated = _Stated(labels, bands, wavelengths, classes or {}, labels_needed)
    draft = _Draft.of(file, variable, rows, stated, layout)
    count = draft.count()
    values = count.take(cube, draft.gaps)
    return SceneFile(values=values, **draft.facts(count))


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
    file, variable = split_variable(path)
    rows, layout = open_rows(path)
    draft = _Draft.of(file, variable, rows, _Stated(labels, bands, wavelengths, {}, False), layout)
    count, height = draft.count(), rows.shape[0]
    for first in range(0, height, BLOCK_LINES):
        last = min(first + BLOCK_LINES, height)
        count.take(rows.read(first, last), draft.gaps_of(first, last))

    def read(first: int, last: int) -> NDArray[np.float32]:
        return as_values(rows.read(first, last), draft.chosen, draft.nodata, draft.gaps_of(first, last))

    facts = draft.facts(count)
    return OpenScene(shape=rows.shape[:2], read=read, missing=count.missing, filled_px=count.filled_px, **facts)


@dataclass(frozen=True)
class _Stated:
    """What was given beside the file."""

    labels: str | Path | None
    bands: Sequence[int] | None
    wavelengths: Sequence[float] | None
    classes: Mapping[str, ClassValue]
    labels_needed: bool


@dataclass(frozen=True)
class _Draft:
    """A scene file of which all is settled but what its numbers are."""

    file: Path
    variable: str | None
    rows: SceneRows
    stated: _Stated
    layout: Layout | None
    settings: SceneSettings
    chosen: list[int]
    light: BandWavelengths
    nodata: float | None
    gaps: NDArray[np.bool_] | None  # (y, x)
    notes: tuple[str, ...]

    @staticmethod
    def of(file: Path, variable: str | None, rows: SceneRows, stated: _Stated, layout: Layout | None) -> _Draft:
        """Settle bands, wavelengths and gaps. Raises what `load_scene_file` does of these."""
        settings, about = find_scene_settings(file), rows.about
        chosen, bad_note = _chosen_bands(stated.bands, settings, rows.shape[2], file, about.bad_bands)
        _refuse_bands_first(file, rows.shape, stated.wavelengths or settings.wavelengths_nm)
        light = settle_wavelengths(
            file,
            chosen,
            rows.shape[2],
            stated=stated.wavelengths,
            settings=settings,
            assumed_nm=about.assumed_nm,
            known=about.known,
        )
        nodata = about.nodata if settings.nodata is None else settings.nodata
        gaps, gap_notes = _gaps(rows.void)
        count = rows.shape[2]
        some = () if chosen == list(range(count)) else (f"bands {bands_text(chosen)} of {count}, counted from 0",)
        notes = (*some, *bad_note, *about.notes, light.origin, *gap_notes)
        return _Draft(file, variable, rows, stated, layout, settings, chosen, light, nodata, gaps, notes)

    def count(self) -> ValueCount:
        """Begin to count what is missing."""
        return ValueCount(self.file, self.chosen, self.nodata, self.rows.shape[:2])

    def gaps_of(self, first: int, last: int) -> NDArray[np.bool_] | None:
        """Gaps of some rows."""
        return None if self.gaps is None else self.gaps[first:last]

    def facts(self, count: ValueCount) -> dict[str, Any]:
        """The fields of `SceneFacts`, once all numbers were counted (SceneError: some cannot be used, or labels)."""
        notes = count.notes()
        found, label_note, by_name = self._labels()
        widths = None if self.light.fwhm_nm is None else self.light.fwhm_nm.tolist()
        said: tuple[str, ...] = () if self.settings.nodata is None else (f"nodata {self.settings.nodata!r}",)
        said += () if self.gaps is None else (f"void {hashlib.sha256(np.packbits(self.gaps).tobytes()).hexdigest()}",)
        said += (self.rows.scaling,) if self.rows.scaling else ()
        content = _content_hash(self.file, self.rows.files)
        light_hash = _digest(content, self.variable, self.chosen, self.light.centre_nm.tolist(), widths, *said)
        content_hash = light_hash
        if found is not None:
            content_hash = _labelled_hash(light_hash, found.names, found.values, found.index)
        return {
            "name": self.file.stem,
            "path": self.file,
            "wavelength_nm": self.light.centre_nm,
            "fwhm_nm": self.light.fwhm_nm,
            "labels": None if found is None else found.index,
            "class_names": () if found is None else found.names,
            "class_colours": np.zeros((0, 3), np.uint8) if found is None else found.colours,
            "class_values": () if found is None else found.values,
            "content_hash": content_hash,
            "light_hash": light_hash,
            "provenance": (*self.notes, *notes, *label_note),
            "geobox": self.rows.about.geobox,
            "labels_found": by_name and self.layout is None and found is not None,
        }

    def _labels(self) -> tuple[Labels | None, tuple[str, ...], bool]:
        """Return labels, a note of them, and whether their file was found by its name alone."""
        stated, shape = self.stated, self.rows.shape[:2]
        by_name = stated.labels is None and self.settings.labels is None
        if self.layout is not None and by_name:
            return self.layout.labels, (self.layout.label_note,), by_name
        try:
            return *_labels(
                self.file, shape, self.rows.about.geobox, stated.labels, self.settings, stated.classes
            ), by_name
        except SceneError as error:
            if stated.labels_needed or not by_name:
                raise
            return None, (f"the labels beside the scene are left out: {error}",), by_name


def _refuse_bands_first(path: Path, shape: tuple[int, ...], wavelengths: Sequence[float] | None) -> None:
    """Refuse a cube that has as many rows as there are wavelengths, and other bands (SceneError)."""
    count = 0 if wavelengths is None else len(wavelengths)
    if count > 1 and shape[0] == count != shape[2] and shape[1] != shape[2]:
        raise SceneError(
            f"{path} has the axes {shape}, read as (y, x, band), and there are {count} wavelengths: its bands come"
            " first; store it with the bands last, np.moveaxis(values, 0, -1)"
        )


def _content_hash(file: Path, named: tuple[Path, ...]) -> str:
    """Of all files that the numbers came from; within a folder their names count, too."""
    files = named or (file,)
    if files == (file,):
        return file_hash(file)
    is_folder = file.is_dir()
    inside = [entry.relative_to(file).as_posix() if is_folder and entry.is_relative_to(file) else "" for entry in files]
    return _digest(*((name, file_hash(entry)) for name, entry in zip(inside, files, strict=True)))


def _gaps(void: NDArray[np.bool_] | None) -> tuple[NDArray[np.bool_] | None, tuple[str, ...]]:
    """(y, x) pixels that are transparent or masked, and a note; None where none is, or all are, which says nothing."""
    if void is None or not void.any():
        return None, ()
    if void.all():
        return None, ("every pixel is transparent or masked, which is not believed",)
    return void, (f"{int(void.sum())} transparent or masked pixels have no value, and no class in a map",)


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


def label_file(scene: Path, settings: SceneSettings) -> tuple[Path | None, str]:
    """Where the labels of a scene lie, by scene.toml or else by their name; and why there are none, if that is told.

    Raises SceneError: scene.toml asks for a number that the scene's name lacks, or several files may be meant.
    """
    if settings.labels is None or settings.path is None:
        return find_label(scene), ""
    if not settings.labels:
        return None, ""
    number = scene_number(scene)
    if "{number}" in settings.labels and number is None:
        raise SceneError(
            f"{scene} has no number in its name, which labels = {settings.labels!r} in scene.toml asks for; write"
            " {name} for the whole name"
        )
    told = settings.labels.replace("{number}", number or "").replace("{name}", scene.stem)
    address = settings.path.parent / told
    if told != settings.labels and not split_layer(address)[0].is_file():
        return None, f"no labels: there is no {address}"
    return address, ""


def _labels(
    scene: Path,
    shape: tuple[int, int],
    geobox: GeoBox | None,
    stated: str | Path | None,
    settings: SceneSettings,
    classes: Mapping[str, ClassValue],
) -> tuple[Labels | None, tuple[str, ...]]:
    address, why_none = (stated, "") if stated is not None else label_file(scene, settings)
    if address is None:
        return None, (why_none,) if why_none else ()
    known, notes = settings.classes or classes, tuple[str, ...]()
    if is_polygon_file(address):
        found, notes = load_polygon_labels(address, shape, geobox, settings=replace(settings, classes=known))
    else:
        found = load_labels(address, shape, classes=known, unlabelled=settings.unlabelled)
    how = f"classes from {settings.path}" if settings.classes else f"{len(found.names)} classes as found in the file"
    by_name = "" if stated is not None or settings.labels is not None else ", found by its name"
    return found, (f"labels from {address}{by_name}, {how}", *notes, *_one_class_note(found))


def load_field_labels(address: str | Path, shape: tuple[int, int]) -> tuple[Labels, tuple[str, ...]]:
    """Read labels on a field's (y, x) pixels, with the classes of a scene.toml beside them; and notes.

    Raises SceneError: they cannot be read, or do not fit.
    """
    file, _ = split_variable(address)
    found, notes = _labels(file, shape, None, address, find_scene_settings(file), {})
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


def scene_number(path: Path) -> str | None:
    """``059_image.png`` -> ``059``: the first digits of the file's name."""
    digits = re.search(r"\d+", path.stem)
    return None if digits is None else digits.group()


def _labelled_hash(
    light_hash: str, names: Sequence[str], values: Sequence[ClassValue], index: NDArray[np.uint8]
) -> str:
    return _digest(light_hash, names, values, hashlib.sha256(np.ascontiguousarray(index).tobytes()).hexdigest())


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
