"""Draw what a survey keeps of two spectra: python tests/benchmarks/draw_kept.py ARCHIVE PICTURE.

The archive's latest run is one that kept its raw lines, ``--keep raw``. The upper spectrum is the median one of its
first sweep by brightness. The lower one is the same with a narrow emission line, condensed once more.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.signal.calibrate import judge_elements
from pipeline.signal.condense import RESIDUAL_STEP, Condenser, ResidualLaw, calibrated_blocks
from storage.archive.archive import Archive
from storage.archive.records import read_run, read_store
from storage.arrays.cubes import RawCube, open_raw_cubes, read_statistics
from storage.arrays.signal_cubes import SignalCube, open_signal_cubes

RAW, KEPT, PART = "0.75", "tab:blue", "tab:orange"
LINE_NM, WIDTH_NM, HEIGHT = 600.0, 8.0, 6.0  # of the planted emission: centre, standard deviation, noise's deviations


@dataclass(frozen=True)
class Compared:
    """One spectrum, (band,) scene values each."""

    title: str
    raw: NDArray[np.float32]
    kept: NDArray[np.float32]
    components_alone: NDArray[np.float32] | None = None  # of a rare spectrum


@dataclass(frozen=True)
class PlantedCube(RawCube):
    """A raw cube with more light in one spectrum."""

    at: tuple[int, int]  # line and sample
    added_dn: NDArray[np.float64]  # (band,)

    def read(self, start: int = 0, stop: int | None = None) -> NDArray[np.uint16]:
        """Return the numbers of some lines, (line, sample, band)."""
        numbers, (line, sample) = super().read(start, stop).copy(), self.at
        if start <= line < start + len(numbers):
            numbers[line - start, sample] += np.rint(self.added_dn).astype(np.uint16)
        return numbers


def compared(root: Path) -> tuple[SignalCube, Compared, Compared]:
    """Return a condensed sweep of the latest run, a median spectrum of it, and one with a planted emission line."""
    archive = Archive.open(root, create=False, write=False)
    products = read_run(archive.runs()[-1], {}).products
    raw, signal = (archive.ref(*products[name].split("/")[1:3]) for name in ("raw_coarse", "signal_coarse"))
    cube, stored = open_raw_cubes(raw.path)[0], open_signal_cubes(signal.path)[0]
    params = read_store(signal).params
    camera, law = LineCamera(**params["camera"]), stored.components
    values = np.concatenate([part for _, part, _ in calibrated_blocks(cube, camera)])
    kept = stored.spectra(0, len(values))
    brightness = np.where(stored.usable, np.nanmean(kept, axis=2), np.nan)
    line, sample = np.unravel_index(np.nanargmin(np.abs(brightness - np.nanmedian(brightness))), brightness.shape)
    usual = Compared("A spectrum like many others", values[line, sample], kept[line, sample])

    emission = HEIGHT * law.noise * np.exp(-(((stored.wavelength_nm - LINE_NM) / WIDTH_NM) ** 2) / 2)
    added = emission / judge_elements(cube.references).gain[sample]
    given = {one.name: getattr(cube, one.name) for one in fields(cube)}
    planted = PlantedCube(**given, at=(int(line), int(sample)), added_dn=added)
    residuals = ResidualLaw.learned(read_statistics(raw.path).spectra, law)
    condenser = Condenser(law, residuals, camera, params["rare_spectra"], params["step"])
    scores = np.zeros((*values.shape[:2], len(law)), np.float32)

    def store(first: int, found: NDArray[np.float32], quality: NDArray[np.uint8]) -> NDArray[np.float32]:
        scores[first : first + len(found)] = np.rint(found / condenser.step) * condenser.step
        return scores[first : first + len(found)]

    done = condenser.sweep(planted, store)
    (number,) = np.flatnonzero((done.rare == (line, sample)).all(axis=1))  # the emission was found
    alone = law.restore(scores[line, sample])
    whole = alone + done.residuals[number] * np.float32(RESIDUAL_STEP) * law.noise.astype(np.float32)
    rare = Compared("A spectrum with an emission line of its own", values[line, sample] + emission, whole, alone)
    return stored, usual, rare


def draw_spectrum(axes: Axes, one: Compared, wavelength_nm: NDArray[np.float64]) -> None:
    """Draw a spectrum as it was captured, and as it is restored."""
    axes.plot(wavelength_nm, one.raw, color=RAW, linewidth=2.5, label="raw")
    if one.components_alone is not None:
        axes.plot(wavelength_nm, one.components_alone, color=PART, linewidth=1, label="components alone")
    axes.plot(wavelength_nm, one.kept, color=KEPT, linewidth=1.2, label="kept")
    axes.set(title=one.title, ylabel="scene value")
    axes.legend(loc="lower right")


def draw_difference(axes: Axes, one: Compared, cube: SignalCube) -> None:
    """Draw what is not kept, in deviations of the noise of each band."""
    noise = cube.components.noise
    axes.axhspan(-1, 1, color="0.9", label="noise, one deviation")
    if one.components_alone is not None:
        lost = (one.raw - one.components_alone) / noise
        axes.plot(cube.wavelength_nm, lost, color=PART, linewidth=1, label="raw - components alone")
    axes.plot(cube.wavelength_nm, (one.raw - one.kept) / noise, color=KEPT, linewidth=1, label="raw - kept")
    axes.set(title="What is not kept", ylabel="deviations of the noise", ylim=(-6, 9))
    axes.legend(loc="upper right")


def draw_kept(root: Path, picture: Path) -> None:
    """Draw both spectra and what is not kept of them."""
    cube, *spectra = compared(root)
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained")
    for (left, right), one in zip(axes, spectra, strict=True):
        draw_spectrum(left, one, cube.wavelength_nm)
        draw_difference(right, one, cube)
    for below in axes[-1]:
        below.set_xlabel("wavelength [nm]")
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    draw_kept(Path(sys.argv[1]), Path(sys.argv[2]))
