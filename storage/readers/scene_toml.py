"""Read ``scene.toml``, and settle the wavelength of each band and its origin."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictInt,
    StrictStr,
    ValidationError,
    model_validator,
)

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.pipeline.setting_fields import numbers_of
from spectralzoom.pipeline.toml_files import read_toml
from spectralzoom.storage.readers.band_facts import RANGE_NM, Bands, axis_hint, bands_text, why_unknown
from spectralzoom.storage.readers.own_files import stated_file
from spectralzoom.storage.readers.user_files import first_there

SETTINGS_NAME = "scene.toml"
IMAGE_FOLDERS = ("images", "image", "imgs", "img", "pictures", "photos")  # scene.toml may be above such a folder

Colour = tuple[int, int, int]
ClassValue = int | Colour
_Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
_Channel = Annotated[int, Field(strict=True, ge=0, le=255)]
_Value = StrictInt | tuple[_Channel, _Channel, _Channel]


def _expanded(value: object) -> object:
    """Return the numbers of a text with ranges, or of a list of numbers and such texts; other values unchanged."""
    items = value.split(",") if isinstance(value, str) else value
    if not isinstance(items, list | tuple):
        return value
    numbers = [number for item in items for number in (numbers_of(item) if isinstance(item, str) else [item])]
    if wrong := [one for one in numbers if isinstance(one, str) and not re.fullmatch(r"\s*\d{1,5}\s*", one)]:
        raise ValueError(f'{wrong[0]!r} is no band; write numbers and ranges such as "0-103,108-148"')
    return tuple(int(one) if isinstance(one, str) else one for one in numbers)


_Numbers = Annotated[tuple[StrictInt, ...], BeforeValidator(_expanded)]


class SceneSettings(BaseModel):
    """Content of one ``scene.toml``. Every key is optional; ``path`` is None if there is no such file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: Path | None = None
    bands: _Numbers | None = None  # of the file, from 0: numbers, or text with ranges such as "0-103,108-148"
    wavelengths_nm: tuple[Annotated[float, Field(strict=True)], ...] | None = None  # of ``bands``, or of all bands
    wavelengths_file: StrictStr | None = None  # rows of nm and FWHM, of all bands of the file and the dropped ones
    dropped_bands: _Numbers = ()  # rows of wavelengths_file that the file lacks, counted from 1: written as bands
    nodata: Annotated[float, Field(strict=True)] | None = None
    scale: _Positive = 1.0  # values = file's * scale + offset
    offset: Annotated[float, Field(strict=True, allow_inf_nan=False)] = 0.0
    pixel_m: _Positive | None = None  # side of a pixel on the ground
    labels: StrictStr | None = None  # relative to scene.toml, with {number} or {name}; "" if there are none
    unlabelled: _Value | None = None
    class_attribute: StrictStr | None = None  # of polygons, with their class
    classes: dict[str, _Value] = {}  # number or colour of each
    colours: dict[str, tuple[_Channel, _Channel, _Channel]] = {}  # of classes on maps

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.wavelengths_nm is not None and self.wavelengths_file is not None:
            raise ValueError("has both wavelengths_nm and wavelengths_file; keep one")
        if len({isinstance(value, tuple) for value in self.classes.values()}) > 1:
            raise ValueError("has some classes that are numbers and some that are colours; use one kind")
        if len(set(self.classes.values())) < len(self.classes):
            raise ValueError("has two classes of the same number or colour; give each its own")
        if self.classes and (unknown := sorted(set(self.colours) - set(self.classes))):
            raise ValueError(f"has colours of {', '.join(unknown)}, which [classes] lacks; name classes of that table")
        if len(self.classes) > 255:
            raise ValueError(f"has {len(self.classes)} classes, at most 255 fit a class map; merge some")
        return self


def find_scene_settings(scene: Path) -> SceneSettings:
    """Read the ``scene.toml`` beside a scene file, or above its folder if that is one such as ``images``.

    Raises SceneError: the file is no TOML, or has an unknown key or a wrong value.
    """
    folders = [scene.parent, scene.parent.parent] if is_image_folder(scene.parent) else [scene.parent]
    found = first_there(folder / SETTINGS_NAME for folder in folders)
    return SceneSettings() if found is None else load_scene_settings(found)


def is_image_folder(folder: Path) -> bool:
    """Return whether a folder has a name for folders of images."""
    return folder.name.lower() in IMAGE_FOLDERS


def load_scene_settings(path: Path) -> SceneSettings:
    """Read one ``scene.toml``; errors as for :func:`find_scene_settings`."""
    try:
        content = read_toml(path)
    except (FileNotFoundError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as TOML: {error}; correct it or remove it") from error
    keys = [name for name in SceneSettings.model_fields if name != "path"]
    if unknown := sorted(set(content) - set(keys)):
        raise SceneError(f"{path} has the unknown key {', '.join(unknown)}; known are {', '.join(keys)}")
    try:
        return SceneSettings.model_validate({**content, "path": path})
    except ValidationError as error:
        first = error.errors()[0]
    key = ".".join(map(str, first["loc"][:2]))
    why = first["msg"].removeprefix("Value error, ")
    raise SceneError(f"{path}: {key}: {why}, got {first['input']!r}; correct it" if key else f"{path} {why}")


MICROMETRES = (0.2, 5.0)


def check_wavelengths(wavelengths: Sequence[float] | NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the wavelengths as float64 [nm] in their order.

    Raises WavelengthError: they are not finite, look like micrometres, or lie outside 200-3000 nm.
    """
    values = np.asarray(wavelengths, np.float64)
    if not np.isfinite(values).all():
        raise WavelengthError(f"{where}: wavelengths must be numbers [nm], got {_listed(values)}")
    if values.size and ((values >= MICROMETRES[0]) & (values <= MICROMETRES[1])).all():
        raise WavelengthError(
            f"{where}: wavelengths {_listed(values)} look like micrometres; write them in nm: {_listed(values * 1000)}"
        )
    outside = values[(values < RANGE_NM[0]) | (values > RANGE_NM[1])]
    if outside.size:
        raise WavelengthError(
            f"{where}: wavelengths {_listed(outside)} lie outside {RANGE_NM[0]:g}-{RANGE_NM[1]:g} nm; write nm, or"
            " leave these bands out"
        )
    return values


def settle_wavelengths(
    path: Path,
    bands: Sequence[int],
    file_bands: int,
    *,
    stated: Sequence[float] | None,
    settings: SceneSettings,
    known: Bands,
    shape: Sequence[int] = (),
) -> Bands:
    """Return wavelengths of the chosen bands [nm] from the flag, else from ``scene.toml``, else from the file.

    ``bands`` count from 0, of ``file_bands``. The flag (``stated``) has one for each of them or for each band of the
    file; ``known`` has one for every band of the file, of a cube with this (y, x, band) ``shape``. Raises
    WavelengthError: there are none, or their number, unit or range is wrong.
    """
    chosen = list(bands)
    if stated is not None:
        values = check_wavelengths(stated, "--wavelengths")
        fitting = _fit(values, chosen, shape or (file_bands,), chosen, f"--wavelengths for {path}")
        return Bands(fitting, None, f"wavelengths stated: {_listed(fitting)} nm")
    if settings.wavelengths_nm is not None:
        values = check_wavelengths(settings.wavelengths_nm, f"{settings.path}: wavelengths_nm")
        own = list(range(file_bands)) if settings.bands is None else list(settings.bands)
        where = f"{settings.path}: wavelengths_nm for {path}"
        fitting = _fit(values, chosen, shape or (file_bands,), own, where)
        return Bands(fitting, None, f"wavelengths from {settings.path}")
    if settings.wavelengths_file is not None and settings.path is not None:
        table = stated_file(settings.path.parent, settings.wavelengths_file, f"{settings.path}: wavelengths_file")
        return _from_file(table, settings.dropped_bands, chosen, file_bands, path)
    advice = f"write wavelengths_nm or wavelengths_file into a {SETTINGS_NAME} beside it, or give survey --wavelengths"
    if known.wavelength_nm is None:
        why = why_unknown(known)
        raise WavelengthError(f"{path} has {file_bands} bands and {why}; {advice} in nm (axes are y, x, band)")
    centre = known.wavelength_nm[chosen]
    if without := [band for band, nm in zip(chosen, centre, strict=True) if np.isnan(nm)]:
        raise WavelengthError(f"{path} gives no wavelength of bands {bands_text(without)} (from 0); {advice} in nm")
    widths = None if known.fwhm_nm is None else known.fwhm_nm[chosen]
    return Bands(check_wavelengths(centre, str(path)), widths, known.origin)


def _fit(
    values: NDArray[np.float64], chosen: list[int], shape: Sequence[int], own: list[int], where: str
) -> NDArray[np.float64]:
    """Return the wavelengths of the chosen bands, out of those of the bands ``own`` or of every band of a cube."""
    file_bands = shape[-1]
    belongs = own if len(values) == len(own) else list(range(file_bands))
    if len(values) != len(belongs):
        ways = f"{len(own)} or {file_bands}" if len(own) != file_bands else f"{file_bands}"
        raise WavelengthError(
            f"{where}: expected {ways} wavelengths, one a band, got {len(values)}; correct the list (axes are y, x,"
            f" band){axis_hint(shape, len(values))}"
        )
    known = dict(zip(belongs, values.tolist(), strict=True))
    if missing := [band for band in chosen if band not in known]:
        raise WavelengthError(f"{where}: nothing for band {missing[0]} (from 0); give --wavelengths with --bands")
    return np.array([known[band] for band in chosen], np.float64)


def _from_file(path: Path, dropped: Sequence[int], chosen: list[int], file_bands: int, image: Path) -> Bands:
    """Return the rows of nm and FWHM, without the dropped ones (counted from 1)."""
    table = _table(path)
    if bad := [row for row in dropped if not 1 <= row <= len(table)]:
        raise WavelengthError(f"dropped_bands has {bad[0]}, but {path} has rows 1..{len(table)}; correct the list")
    kept = np.delete(table, [row - 1 for row in set(dropped)], axis=0)
    if len(kept) != file_bands:
        raise WavelengthError(
            f"{path} has {len(table)} rows, {len(set(dropped))} of them dropped, which leaves {len(kept)} wavelengths "
            f"for the {file_bands} band{'s' * (file_bands != 1)} of {image}; correct dropped_bands in scene.toml"
        )
    centre = check_wavelengths(kept[:, 0], str(path))[chosen]
    widths = kept[:, 1] if kept.shape[1] > 1 else None
    known = widths is not None and bool((np.isfinite(widths) & (widths > 0)).all())
    return Bands(centre, widths[chosen] if known and widths is not None else None, f"wavelengths from {path}")


def _table(path: Path) -> NDArray[np.float64]:
    """Return the rows of a text file that begin with a number, as (row, 1 or 2)."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise WavelengthError(f"wavelengths_file {path} cannot be read: {error}; correct scene.toml") from error
    rows: list[list[float]] = []
    for line in lines:
        commas = re.match(r"\s*\d+,\d+(\s*[;\t]\s*\d+(,\d+)?|\s+\d+,\d+)\b", line)  # 450,5 10,2
        fields = re.sub("[,;]", " ", line.replace(",", ".") if commas else line).split()[:2]
        for count in range(len(fields), 0, -1):
            with suppress(ValueError):
                rows.append([float(field) for field in fields[:count]])
                break
    if not rows:
        raise WavelengthError(f"{path} has no row that begins with a number; expected columns of nm and FWHM")
    columns = min(map(len, rows))
    return np.array([row[:columns] for row in rows], np.float64)


def _listed(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:g}" for value in values[:6]) + (f", ... ({values.size})" if values.size > 6 else "")
