"""Formats for the lines of a scan: their errors, their bytes, and refused scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.tradeoff import store
from flows.tradeoff.command import tradeoff
from flows.tradeoff.entries import Point, measure_tradeoff
from flows.tradeoff.store import STORE, WAYS, ScanLines, block_means_of, scan_farm, scan_raster, store_tradeoff
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera

SMALL = (96, 128)
BLOCK, MIOU = "mean of 64² [σ]", "mIoU [%]"  # noqa: RUF001
STEPS = tuple(f"condensed, step {step:g}" for step in store.STEPS[::3])
ROUNDED = tuple(f"pcodec, rounded {step:g}" for step in store.ROUNDED[::2])
PRINCIPAL = ("PCA, step 0.5", "PCA, step 3")
PACKED = ("PCA, JPEG 2000, 2 B", "condensed, JPEG 2000, 2 B")


@pytest.fixture(scope="module")
def farm() -> ScanLines:
    """Return the lines of a small farm."""
    return scan_farm(3, SMALL, LineCamera(samples=144))


@pytest.fixture(scope="module")
def points(farm: ScanLines) -> dict[str, Point]:
    """Return the points of formats of each family on these lines, by name."""
    settings = ("raw", *STEPS, *ROUNDED, *PRINCIPAL, *PACKED, "binned, 17 bands")
    found = measure_tradeoff(replace(STORE, prepare=lambda seed: farm, settings=settings), repeats=1)
    return {str(point.setting): point for point in found.points}


def cube_of(path: Path, shape: tuple[int, int, int] = (24, 24, 12), offset: float = 0.0) -> str:
    """Write integers of two materials with noise, as a raster without labels; return its path."""
    rng = np.random.default_rng(0)
    spectra = np.linspace(800, 2000, shape[2])[None] * np.array([[1.0], [1.4]])
    values = spectra[(np.arange(shape[0]) > 9).astype(int)][:, None] + rng.normal(0, 9, shape)
    np.save(path, np.rint(values) + offset)
    (path.parent / "scene.toml").write_text(f"wavelengths_nm = {np.linspace(400, 900, shape[2]).tolist()}\n")
    return str(path)


def test_bytes_fall_with_the_step_and_the_error_grows(points: dict[str, Point]) -> None:
    """This holds for condensed spectra, rounded values and principal components."""
    for family in (STEPS, ROUNDED, PRINCIPAL):
        rows = [points[name] for name in family]
        sizes, errors = [row.cost for row in rows], [row.error for row in rows]
        assert sizes == sorted(sizes, reverse=True)
        assert errors == sorted(errors)
        assert len({*sizes}) == len({*errors}) == len(rows)


def test_raw_lines_have_the_error_of_their_noise_and_components_less(points: dict[str, Point]) -> None:
    """Raw lines err by one sigma of the simulator; ten components of 270 hold a twentieth of the noise variance."""
    assert points["raw"].error == pytest.approx(1, abs=0.01)
    fine = points[STEPS[0]]
    assert fine.error < 0.3
    assert fine.cost < points["raw"].cost / 10
    assert points["binned, 17 bands"].beside[BLOCK] > 1 > points["raw"].beside[BLOCK]


def test_maps_are_made_from_the_restored_lines(points: dict[str, Point]) -> None:
    """Fine components give a map within 5 points of raw lines; wide bins lose more than 5."""
    assert 0 < points["binned, 17 bands"].beside[MIOU] < points["raw"].beside[MIOU] - 5
    assert points[STEPS[0]].beside[MIOU] == pytest.approx(points["raw"].beside[MIOU], abs=5)


def test_jpeg_2000_takes_few_bytes(points: dict[str, Point]) -> None:
    """PCA and condensed spectra take less than a quarter of raw bytes; condensed ones err by less than the noise."""
    pca, condensed = (points[name] for name in PACKED)
    assert max(pca.cost, condensed.cost) < points["raw"].cost / 4
    assert condensed.error < 1


def test_lossless_formats_restore_the_raw_lines(farm: ScanLines) -> None:
    """They are equal to the last bit; rounding errs by at most half a step."""
    for name in ("raw", "pcodec, exact"):
        np.testing.assert_array_equal(WAYS[name](farm).restore(), farm.values)
    unit = 0.5 * farm.noise_dn.astype(np.float32)
    limit = farm.lines.calibrated(np.zeros_like(farm.values) + unit / 2 + 64) * 1.001
    assert (np.abs(WAYS["pcodec, rounded 0.5"](farm).restore() - farm.values) <= limit + 1e-6).all()


def test_a_raster_is_measured_by_its_own_pixels(tmp_path: Path) -> None:
    """Its raw row has no error, it has no mIoU without weights, and its noise is estimated."""
    entry = replace(store_tradeoff(cube_of(tmp_path / "cube.npy"), None), settings=("raw", *STEPS))
    raw, *condensed = measure_tradeoff(entry, repeats=1).points
    assert raw.error == raw.beside[BLOCK] == 0
    assert np.isnan(raw.beside[MIOU])
    assert all(0.5 < point.error < 1.2 for point in condensed)
    assert scan_raster(str(tmp_path / "cube.npy"), None).noise_dn == pytest.approx(9, rel=0.3)


def test_scenes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """Other stages take no scene, scene and weights need each other, and fractional values are no raw DN."""
    weights = Path("w.safetensors")
    for stage, scene, read_by in (
        ("rectify", "cube.npy", weights),
        ("survey", "cube.npy", None),
        (None, "cube.npy", None),
        ("store", None, weights),
    ):
        with pytest.raises(SettingsError, match="--scene FILE and --weights FILE go together, with the stages segment"):
            tradeoff(stage, scene=scene, weights=read_by, out=tmp_path)
    with pytest.raises(SceneError, match="numbers other than whole ones from 0 to 65534"):
        scan_raster(cube_of(tmp_path / "cube.npy", offset=0.5), None)


def test_block_means_use_whole_blocks() -> None:
    """Partial blocks are left out; a smaller image is one block."""
    values = np.arange(4 * 6, dtype=np.float32).reshape(4, 6, 1)
    np.testing.assert_array_equal(block_means_of(values, 2)[..., 0], [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]])
    assert block_means_of(values, 5).shape == (1, 1, 1)
    assert block_means_of(values[:, :3], 64).item() == values[:, :3].mean()
