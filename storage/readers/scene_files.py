"""Scene files: an image or cube with its wavelengths and labels, as a simulated rig looks at it."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from pipeline.readings import MOST_STEPS, MOST_VALUE, beyond_range, find_beyond
from pipeline.simulator.scenes.scene import BRIGHT_PERCENTILE
from storage.archive.staging import file_hash
from storage.readers.cube_sources import BLOCK_LINES, Raster, machine_bytes, scene_lines
from storage.readers.label_files import find_label
from storage.readers.labels import Labels, load_frame_or_raster, load_labels
from storage.readers.polygon_labels import is_polygon_file, load_polygon_labels
from storage.readers.raster_files import split_variable
from storage.readers.scan_files import known_bands, open_cube_source, reader_of
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings, settle_wavelengths
from storage.readers.zone_files import split_layer

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

_LOOKED_AT = 1 << 20  # values, evenly spread, by which the range of a scene is told


@dataclass(frozen=True)
class SceneFile:
    """A scene as its file gives it, on the file's own pixels."""

    name: str
    path: Path
    values: NDArray[np.float32]  # (y, x, band), NaN where the file has none
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None  # (band,)
    labels: NDArray[np.uint8] | None  # (y, x) class index, 255 = unlabelled
    class_names: tuple[str, ...]
    class_colours: NDArray[np.uint8]  # (class, 3)
    class_values: tuple[ClassValue, ...]  # what each class is in the label file: a number or a colour
    content_hash: str  # of everything above
    light_hash: str  # of values and wavelengths alone: labels do not change what a camera sees
    provenance: tuple[str, ...]  # one sentence for each thing assumed or left out
    geobox: GeoBox | None = None  # where the pixels lie on the earth
    labels_found: bool = False  # by the file's name: nobody stated them

    def without_labels(self, note: str) -> SceneFile:
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

    def with_labels(self, labels: NDArray[np.uint8], note: str) -> SceneFile:
        """The same scene with other labels; hash and provenance say so."""
        digest = _labelled_hash(self.light_hash, self.class_names, self.class_values, labels)
        return replace(self, labels=labels, content_hash=digest, provenance=(*self.provenance, note))


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
    settings = find_scene_settings(file)
    cube = raster.three_axes(file)
    chosen, bad_note = _chosen_bands(bands, settings, cube.shape[2], file, raster.bad_bands)
    _refuse_bands_first(file, cube.shape, wavelengths or settings.wavelengths_nm)
    light = settle_wavelengths(
        file,
        chosen,
        cube.shape[2],
        stated=wavelengths,
        settings=settings,
        assumed_nm=raster.assumed_nm,
        known=raster.known,
    )
    nodata = raster.nodata if settings.nodata is None else settings.nodata
    gaps, gap_notes = _gaps(raster)
    values, notes = _as_float(cube, chosen, nodata, file, gaps)
    shape = (cube.shape[0], cube.shape[1])
    by_name = labels is None and settings.labels is None
    label_note: tuple[str, ...]
    if layout is not None and by_name:
        found, label_note = layout.labels, (layout.label_note,)
    else:
        try:
            found, label_note = _labels(file, shape, raster.geobox, labels, settings, classes or {})
        except SceneError as error:
            if labels_needed or not by_name:
                raise
            found, label_note = None, (f"the labels beside the scene are left out: {error}",)
    count, widths = cube.shape[2], None if light.fwhm_nm is None else light.fwhm_nm.tolist()
    some_bands = () if chosen == list(range(count)) else (f"bands {bands_text(chosen)} of {count}, counted from 0",)
    stated: tuple[str, ...] = () if settings.nodata is None else (f"nodata {settings.nodata!r}",)
    stated += () if gaps is None else (f"void {hashlib.sha256(np.packbits(gaps).tobytes()).hexdigest()}",)
    stated += (raster.scaling,) if raster.scaling else ()
    light_hash = _digest(_content_hash(file, raster), variable, chosen, light.centre_nm.tolist(), widths, *stated)
    content_hash = light_hash
    if found is not None:
        content_hash = _labelled_hash(light_hash, found.names, found.values, found.index)
    return SceneFile(
        name=file.stem,
        path=file,
        values=values,
        wavelength_nm=light.centre_nm,
        fwhm_nm=light.fwhm_nm,
        labels=None if found is None else found.index,
        class_names=() if found is None else found.names,
        class_colours=np.zeros((0, 3), np.uint8) if found is None else found.colours,
        class_values=() if found is None else found.values,
        content_hash=content_hash,
        light_hash=light_hash,
        provenance=(*some_bands, *bad_note, *raster.notes, light.origin, *gap_notes, *notes, *label_note),
        geobox=raster.geobox,
        labels_found=by_name and layout is None and found is not None,
    )


def load_scan(address: str | Path) -> Raster:
    """Read a cube that comes in lines as one array, over the white panel where dark and white frames are known.

    Raises SceneError: the cube cannot be used, or this machine has not the memory for it.
    """
    source = open_cube_source(address)
    needed = 8 * math.prod(source.shape)  # as float32, and once more while the scene is made
    there = machine_bytes()
    if needed > there:
        raise SceneError(
            f"{address} is a cube of {source.shape}: as a scene it takes about {needed / 1e9:.0f} GB of memory, this "
            f"machine has {there / 1e9:.0f}; cut a part out of it, or ingest it"
        )
    starts = range(0, source.shape[0], BLOCK_LINES)
    blocks = [scene_lines(source, start, min(start + BLOCK_LINES, source.shape[0])) for start in starts]
    over = source.dark is not None and source.white is not None
    notes = (*source.notes, "values are over the white panel") if over else source.notes
    return Raster(
        np.concatenate(blocks),
        None,
        None if over else source.nodata,
        notes,
        known=known_bands(source),
        files=source.files,
        geobox=source.geobox,
        bad_bands=source.bad_bands,
    )


def _refuse_bands_first(path: Path, shape: tuple[int, ...], wavelengths: Sequence[float] | None) -> None:
    """Refuse a cube that has as many rows as there are wavelengths, and other bands (SceneError)."""
    count = 0 if wavelengths is None else len(wavelengths)
    if count > 1 and shape[0] == count != shape[2] and shape[1] != shape[2]:
        raise SceneError(
            f"{path} has the axes {shape}, read as (y, x, band), and there are {count} wavelengths: its bands come"
            " first; store it with the bands last, np.moveaxis(values, 0, -1)"
        )


def _content_hash(file: Path, raster: Raster) -> str:
    """Of all files that the numbers came from; within a folder their names count, too."""
    files = raster.files or (file,)
    if files == (file,):
        return file_hash(file)
    is_folder = file.is_dir()
    inside = [entry.relative_to(file).as_posix() if is_folder and entry.is_relative_to(file) else "" for entry in files]
    return _digest(*((name, file_hash(entry)) for name, entry in zip(inside, files, strict=True)))


def _gaps(raster: Raster) -> tuple[NDArray[np.bool_] | None, tuple[str, ...]]:
    """(y, x) pixels that are transparent or masked, and a note; None where none is, or all are, which says nothing."""
    if raster.void is None or not raster.void.any():
        return None, ()
    if raster.void.all():
        return None, ("every pixel is transparent or masked, which is not believed",)
    return raster.void, (f"{int(raster.void.sum())} transparent or masked pixels have no value, and no class in a map",)


def bands_text(bands: Sequence[int]) -> str:
    """Band numbers as ``--bands`` takes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for band in bands:
        if runs and band == runs[-1][1] + 1:
            runs[-1][1] = band
        else:
            runs.append([band, band])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)


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


def _as_float(
    cube: NDArray[Any], chosen: list[int], nodata: float | None, path: Path, gaps: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Chosen bands as float32; gaps (y, x), the no-data value and infinities become NaN, and are counted.

    Raises SceneError where another value is no reading, a band has no value anywhere, or no value is finite.
    """
    every = chosen == list(range(cube.shape[2]))
    picked = cube if every else cube[..., chosen]
    notes: list[str] = []
    if gaps is not None:
        picked = np.where(gaps[..., None], picked.dtype.type(0), picked)  # whatever lies under them is no value
    with np.errstate(over="ignore"):
        values = np.array(picked, np.float32, order="C")
    if gaps is not None:
        values[gaps] = np.nan
    strange = beyond_range(picked)
    if nodata is not None:
        # Compared as numbers: -9999 in the numbers of the file would wrap to 55537 where they are uint16.
        with np.errstate(over="ignore"):
            void = picked == nodata if np.isfinite(nodata) else np.isnan(values)
        values[void] = np.nan
        notes.append(f"{int(void.sum())} samples have the file's no-data value {nodata:g}")
        picked = picked if strange is None else np.where(void, picked.dtype.type(0), picked)
    if strange is not None and (found := find_beyond(picked)) is not None:
        raise SceneError(
            f"{path} has {found.words(np.array(chosen))}, beyond the {MOST_VALUE:g} that readings reach; if it stands"
            f" for no data, write nodata = {found.value!s} into a {SETTINGS_NAME} beside the file, else leave the band"
            " out with --bands, or give the values in a larger unit"
        )
    infinite = np.isinf(values)
    if infinite.any():
        values[infinite] = np.nan
        y, x, band = np.unravel_index(int(infinite.argmax()), infinite.shape)
        place = f"y {y}, x {x}, band {chosen[int(band)]}"
        notes.append(f"{int(infinite.sum())} infinite samples count as missing, the first at {place}")
    missing = int(np.isnan(values).sum())
    if missing == values.size:
        raise SceneError(f"{path} holds no finite number in the bands used; choose others")
    _check_empty(values, chosen, path)
    if missing:
        notes.append(f"{missing} of {values.size} samples are missing")
    return values, (*notes, *_dark_note(values))


def _check_empty(values: NDArray[np.float32], chosen: list[int], path: Path) -> None:
    """Refuse bands without a value anywhere (SceneError, with the ``--bands`` that leaves them out)."""
    empty = [band for place, band in enumerate(chosen) if np.isnan(values[..., place]).all()]
    if empty:
        rest = bands_text([band for band in chosen if band not in set(empty)])
        raise SceneError(
            f"{path} has no value anywhere in bands {bands_text(empty)} (from 0); take the others: --bands {rest}"
        )


def _dark_note(values: NDArray[np.float32]) -> tuple[str, ...]:
    """Say where the bright end is so far above all else that hardly any light is left for it."""
    some = values.reshape(-1)[:: max(1, values.size // _LOOKED_AT)]
    lit = some[some > 0]  # no NaN
    if not lit.size:
        return ()
    middle, bright = (float(value) for value in np.percentile(lit, (50, BRIGHT_PERCENTILE)))
    if bright <= MOST_STEPS * middle:
        return ()
    return (
        f"the brightest values, {bright:.3g}, are more than {MOST_STEPS} times the middle one, {middle:.3g}, and all"
        f" else is dark beside them; if they stand for no data, write nodata = {float(lit.max())!r} into a"
        f" {SETTINGS_NAME}",
    )


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
