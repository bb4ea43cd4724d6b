"""Dark and white reference frames of a pushbroom camera, from a folder of ENVI files to the references of a sweep."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import SceneError
from pipeline.rectify.calibration.detector import BadElementCriteria, find_bad_elements
from pipeline.source import References
from storage.readers.envi_cubes import EnviCube, open_envi_cube

LEAST_ABOVE_DARK = 0.5  # share of the elements; with less the frames are swapped, or the lamp was off
LEVEL_DN = 2.0  # by which the frames' levels may differ where no light falls


@dataclass(frozen=True)
class ReferenceFrames:
    """A camera's references as its files give them, with what was found in them."""

    references: References
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    fwhm_nm: NDArray[np.float64] | None  # (band,)
    without_light: int  # elements whose white is not above their dark
    notes: tuple[str, ...]


def load_reference_frames(
    folder: str | Path,
    *,
    panel: ArrayLike = 1.0,
    saturated_dn: float | None = None,
    criteria: BadElementCriteria | None = None,
) -> ReferenceFrames:
    """Read ``darkReference`` and ``whiteReference`` of a folder as Headwall cameras leave them.

    Frames of several lines are averaged. Wavelengths come from the dark frame's header, or from the white one's.

    Parameters
    ----------
    folder
        Holds both files with their headers; the endings and capitals of the names do not matter.
    panel
        Value of the white panel, one or (band,).
    saturated_dn
        Least DN of a saturated white frame; None where it is known not to be.
    criteria
        Of :func:`pipeline.rectify.calibration.detector.find_bad_elements`, which marks bad elements.

    Raises
    ------
    SceneError : a file is missing or damaged, the frames do not fit each other, or white is not above dark in half of
        the elements.
    RigError : more elements look bad than a detector can have.
    """
    dark_file, white_file = (_open(Path(folder), name) for name in ("darkreference", "whitereference"))
    dark, white = _mean(dark_file), _mean(white_file)
    if dark.shape != white.shape:
        raise SceneError(
            f"{dark_file.path} is {dark.shape} (sample, band), {white_file.path} {white.shape}; take both anew"
        )
    lit = np.count_nonzero(white > dark)
    if lit < LEAST_ABOVE_DARK * dark.size:
        raise SceneError(
            f"{white_file.path} is above {dark_file.path.name} in {100 * lit / dark.size:.0f} % of the elements; "
            "are they swapped, or was the lamp off?"
        )
    values = np.asarray(panel, np.float32)
    if values.shape not in ((), (dark.shape[1],)):
        raise SceneError(f"panel has shape {values.shape}, expected one value or one for each of {dark.shape[1]} bands")
    bad = find_bad_elements(dark, white, criteria=criteria, saturated_dn=saturated_dn)
    lights = dark_file.header if dark_file.header.wavelength_nm is not None else white_file.header
    found = f"{np.count_nonzero(bad)} of {bad.size} elements are bad"
    return ReferenceFrames(
        references=References(dark, white, np.broadcast_to(values, dark.shape[1]).copy(), bad),
        wavelength_nm=lights.wavelength_nm,
        fwhm_nm=lights.fwhm_nm,
        without_light=dark.size - int(lit),
        notes=(*dark_file.notes, *white_file.notes, found, *_level_note(dark, white)),
    )


def _open(folder: Path, name: str) -> EnviCube:
    if not folder.is_dir():
        raise SceneError(f"there is no folder {folder}; name the one that holds the reference frames")
    headers = [
        file for file in sorted(folder.iterdir())
        if file.suffix.lower() == ".hdr" and file.name.lower().split(".")[0] == name
    ]  # fmt: skip
    if len(headers) != 1:
        listed = ", ".join(file.name for file in headers) or "none"
        raise SceneError(f"expected one header named {name}.hdr in {folder}, found {listed}")
    return open_envi_cube(headers[0])


def _mean(cube: EnviCube) -> NDArray[np.float32]:
    """(sample, band) mean over the lines."""
    if cube.values.dtype.kind not in "uif":
        raise SceneError(f"{cube.path} holds {cube.values.dtype}, expected real numbers")
    return np.asarray(cube.values.mean(axis=0, dtype=np.float64), np.float32)


def _level_note(dark: NDArray[np.float32], white: NDArray[np.float32]) -> tuple[str, ...]:
    """Where no light falls white equals dark; if it lies below, the white was taken with another dark level."""
    level = np.median(white - dark, axis=0)
    unlit = level < -LEVEL_DN
    if not unlit.any():
        return ()
    return (
        f"white lies up to {-level.min():.1f} DN below dark in {np.count_nonzero(unlit)} bands: it was taken with "
        "another dark level, which makes the reflectance of weakly lit bands wrong",
    )
