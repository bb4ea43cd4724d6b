"""Dark and white frames of a camera's folder become references that fit, with what is wrong with them said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SceneError
from pipeline.rectify.calibration.calibrate import calibrate
from storage.reference_frames import load_reference_frames

SHAPE = (30, 6)  # sample, band


def write_frame(folder: Path, name: str, frames: np.ndarray, kind: str, more: str = "") -> None:
    """One ENVI file in BIP, (line, sample, band)."""
    code = {"u2": 12, "f4": 4, "c8": 6}[kind]
    lines, samples, bands = frames.shape
    (folder / f"{name}.bin").write_bytes(np.ascontiguousarray(frames, f"<{kind}").tobytes())
    (folder / f"{name}.hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\ndata type = {code}\ninterleave = bip\n"
        f"byte order = 0\n{more}"
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three dark lines of 59, 60 and 61 DN with wavelengths, one white line of 1060 DN without."""
    dark = np.array([59, 60, 61])[:, None, None] + np.zeros((3, *SHAPE))
    wavelengths = "wavelength units = nm\nwavelength = {400,500,600,700,800,900}\nfwhm = {5,5,5,5,5,5}\n"
    write_frame(tmp_path, "darkReference", dark, "u2", wavelengths)
    write_frame(tmp_path, "whiteReference", np.full((1, *SHAPE), 1060.0), "f4")
    return tmp_path


def test_frames_are_means_over_the_lines(folder: Path) -> None:
    """Lines are averaged, the panel is spread over the bands, wavelengths come from the frame that has them."""
    found = load_reference_frames(folder, panel=0.95)
    np.testing.assert_array_equal(found.references.dark, np.full(SHAPE, 60, np.float32))
    np.testing.assert_array_equal(found.references.white, np.full(SHAPE, 1060, np.float32))
    np.testing.assert_array_equal(found.references.panel, np.full(6, 0.95, np.float32))
    np.testing.assert_array_equal(found.wavelength_nm, np.arange(400, 901, 100))
    np.testing.assert_array_equal(found.fwhm_nm, np.full(6, 5))
    assert (found.without_light, found.notes) == (0, ("0 of 180 elements are bad",))


def test_references_calibrate(folder: Path) -> None:
    """Raw lines half way between the frames are half the panel."""
    found = load_reference_frames(folder, panel=np.linspace(0.5, 1, 6))
    values, valid = calibrate(np.full((2, *SHAPE), 560, np.uint16), found.references, saturated_dn=4095)
    np.testing.assert_allclose(values[0, 0], np.linspace(0.25, 0.5, 6), rtol=1e-6)
    assert valid.all()


def test_bad_elements_are_marked(folder: Path) -> None:
    """A hot element of the dark frame is bad, and counted."""
    dark = np.full((1, *SHAPE), 60)
    dark[0, 11, 2] = 400
    write_frame(folder, "darkReference", dark, "u2")
    found = load_reference_frames(folder)
    assert found.references.bad is not None
    assert np.argwhere(found.references.bad).tolist() == [[11, 2]]
    assert found.wavelength_nm is None
    assert "1 of 180 elements are bad" in found.notes


def test_another_dark_level_is_noted(folder: Path) -> None:
    """White below dark where no light falls says that the two do not belong together."""
    white = np.full((1, *SHAPE), 1060.0)
    white[..., 4:] = 52
    write_frame(folder, "whiteReference", white, "f4")
    found = load_reference_frames(folder)
    assert found.without_light == 60
    assert found.notes[-1].startswith("white lies up to 8.0 DN below dark in 2 bands: it was taken with another dark")


def test_what_does_not_fit_is_refused(folder: Path) -> None:
    """Swapped frames, other sizes, other panels, complex numbers and missing files are named."""
    with pytest.raises(SceneError, match=r"panel has shape \(4,\), expected one value or one for each of 6 bands"):
        load_reference_frames(folder, panel=np.ones(4))
    write_frame(folder, "whiteReference", np.full((1, *SHAPE), 20.0), "f4")
    with pytest.raises(SceneError, match=r"above darkReference\.bin in 0 % of the elements; are they swapped"):
        load_reference_frames(folder)
    write_frame(folder, "whiteReference", np.full((1, 30, 5), 1060.0), "f4")
    with pytest.raises(SceneError, match=r"is \(30, 6\) \(sample, band\), .* \(30, 5\); take both anew"):
        load_reference_frames(folder)
    write_frame(folder, "whiteReference", np.full((1, *SHAPE), 1060.0), "c8")
    with pytest.raises(SceneError, match="complex64, expected real numbers"):
        load_reference_frames(folder)
    (folder / "whiteReference.hdr").unlink()
    with pytest.raises(SceneError, match=r"one header named whitereference\.hdr in .*, found none"):
        load_reference_frames(folder)
    with pytest.raises(SceneError, match="there is no folder"):
        load_reference_frames(folder / "none")


def test_frames_of_a_real_camera(real_data: Path) -> None:
    """A Headwall camera: BIL and BIP agree, a detector as sound as they come, and a white with another dark level."""
    found = load_reference_frames(real_data / "headwall_references")
    dark, bad = found.references.dark, found.references.bad
    assert dark.shape == found.references.white.shape == (1020, 301)
    np.testing.assert_allclose(found.wavelength_nm, np.arange(400, 1001, 2))
    assert bad is not None
    assert np.count_nonzero(bad) == 197
    np.testing.assert_array_equal(bad, dark > np.median(dark, axis=0) + 8 * np.maximum(1, _spread(dark)))
    assert found.without_light == 29421
    assert found.notes[-1].startswith("white lies up to 8.0 DN below dark in 19 bands")


def _spread(dark: np.ndarray) -> np.ndarray:
    return 1.4826 * np.median(np.abs(dark - np.median(dark, axis=0)), axis=0)
