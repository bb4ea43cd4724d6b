"""The note on scenes unlike the training: false alarms on held-out scenes of the same kind, and shifts that are found.

Held out are tiles of Indian Pines, frames of CWFID, the other half of a scene, and built-in farms of other seeds, also
with the noise of 3 ms. Shifts change the spectra of these scenes; other ground has the same bands and median. Built-in
farms of other days have spectra that the training knows; surveys note their day instead.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from measure import Row, data_folder, not_run, print_rows
from numpy.typing import NDArray
from PIL import Image

from spectralzoom.flows.opening.survey_model import shipped_weights
from spectralzoom.flows.training.data import farm_test_data
from spectralzoom.flows.training.train_scenes import CAMERA
from spectralzoom.models.evaluation.unlike_scenes import STRIDE, UNLIKE, TrainingSpectra
from spectralzoom.models.network.spectral import Normalisation, SpectralBasis, project
from spectralzoom.models.training.examples import observe_scene
from spectralzoom.models.weights.files import describe_weights, load_weights
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW, SCOUTING_LAW

TILE, TILE_SEEDS, FRAME_SEEDS, TRAINED = (29, 36), (31, 32, 33), (41, 42), 12
FARMS, OTHER_DAYS, DARK_MS = 6, (20, 340), 3.0
Floats = NDArray[np.floating]


@dataclass
class Tally:
    """Notes on scenes of the same kind, and on shifted ones by the name of the shift."""

    alike: list[bool] = field(default_factory=list)
    found: dict[str, list[bool]] = field(default_factory=dict)


@dataclass(frozen=True)
class Known:
    """A training, by whose statistics spectral columns (y, x, column) are judged."""

    normalisation: Normalisation
    spectra: TrainingSpectra

    @staticmethod
    def trained(scenes: Sequence[Floats]) -> Known:
        """Measure a training on columns of scenes."""
        some = [one[::STRIDE, ::STRIDE].reshape(-1, one.shape[-1]) for one in scenes]
        normalisation = Normalisation.measured(np.concatenate(some))
        whole = np.ones(scenes[0].shape[-1], np.bool_)
        spectra = TrainingSpectra.measured([normalisation.apply(one, whole) for one in scenes], normalisation.whitening)
        assert spectra is not None
        return Known(normalisation, spectra)

    def warns(self, columns: Floats) -> bool:
        """Return whether a survey of these columns has the note."""
        normal = self.normalisation.apply(columns[::STRIDE, ::STRIDE], np.ones(columns.shape[-1], np.bool_))
        return max(self.spectra.distances(self.spectra.of(normal))) > UNLIKE


def shifts(columns: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield the columns with other gain, with a tilt over wavelength, and with haze, which adds a spectrum."""
    at = np.linspace(0, 1, columns.shape[-1])
    for gain in (0.5, 0.7, 1.4):
        yield f"gain {gain}", gain * columns
    for tilt in (-0.4, 0.4):
        yield f"tilt {tilt:+}", columns * (1 + tilt * (2 * at - 1))
    for haze in (0.15, 0.4):
        yield f"haze {haze}", columns + haze * np.median(columns) * np.exp(-2 * at)


def judge(tally: Tally, known: Known, scenes: Sequence[Floats]) -> None:
    """Count the notes on columns of held-out scenes, as they are and shifted."""
    tally.alike += [known.warns(one) for one in scenes]
    for one in scenes:
        for name, shifted in shifts(one):
            tally.found.setdefault(name, []).append(known.warns(shifted))


def on_columns(values: Floats, nm: Floats, of: Floats) -> Floats:
    """Return the columns of a scene (y, x, band), on the basis of a training on the bands ``of``."""
    return project(values, SpectralBasis.spanning(of, 256).matrix(nm)[0])


def split(scenes: Sequence[Floats], seed: int, held_out: int) -> tuple[list[Floats], list[Floats]]:
    """Return scenes for training and held-out ones."""
    order = np.random.default_rng(seed).permutation(len(scenes))
    return [scenes[n] for n in order[:TRAINED]], [scenes[n] for n in order[TRAINED : TRAINED + held_out]]


def pines(folder: Path) -> tuple[Floats, Floats]:
    """Return Indian Pines (y, x, band) and its wavelengths."""
    values = np.load(folder / "indian_pines" / "Indian_pines_corrected.npy").astype(np.float32)
    return values, np.linspace(400, 2500, values.shape[-1])


def unmixing(folder: Path, name: str) -> tuple[Floats, Floats]:
    """Return Jasper Ridge or Samson (y, x, band) and its wavelengths."""
    file: dict[str, Any] = scipy.io.loadmat(folder / "jasper_samson" / name)
    values = file["Y"].T.reshape(file["nRow"].item(), file["nCol"].item(), -1, order="F").astype(np.float32)
    if "SlectBands" in file:
        return values, np.linspace(380, 2500, 224)[file["SlectBands"].ravel().astype(int) - 1]
    return values, np.linspace(401, 889, values.shape[-1])


def judged_files(folder: Path) -> dict[str, Tally]:
    """Judge tiles, frames, and halves of scenes."""
    found = {name: Tally() for name in ("tiles of Indian Pines", "field frames", "other half of a scene")}
    values, nm = pines(folder)
    columns = on_columns(values, nm, nm)
    tiles = [
        columns[y : y + TILE[0], x : x + TILE[1]]
        for y in range(0, values.shape[0], TILE[0])
        for x in range(0, values.shape[1] - TILE[1], TILE[1])
    ]
    for seed in TILE_SEEDS:
        train, held_out = split(tiles, seed, len(tiles))
        judge(found["tiles of Indian Pines"], Known.trained(train), held_out)
    files = sorted((folder / "cwfid" / "images").glob("*.png"))
    frames = [np.asarray(Image.open(one))[..., :2].astype(np.float32) for one in files]
    for seed in FRAME_SEEDS:
        train, held_out = split(frames, seed, 8)
        judge(found["field frames"], Known.trained(train), held_out)
    scenes = [unmixing(folder, "JasperRidge2_R198.mat"), unmixing(folder, "Samson.mat"), (values, nm)]
    tally = found["other half of a scene"]
    for number, (one, nm) in enumerate(scenes):
        first, second = np.array_split(on_columns(one, nm, nm), 2)
        known = Known.trained([first])
        judge(tally, known, [second])
        for other, other_nm in scenes[:number] + scenes[number + 1 :]:
            same = np.stack([other[..., np.abs(other_nm - band).argmin()] for band in nm], axis=-1)
            scaled = on_columns(same * np.median(one) / np.median(same), nm, nm)
            tally.found.setdefault("other ground", []).append(known.warns(scaled))
    return found


def judged_farms() -> dict[str, Tally]:
    """Judge built-in farms of other seeds by the shipped weights."""
    weights, found = load_weights(shipped_weights()), {}
    spectra = describe_weights(shipped_weights()).spectra
    assert spectra is not None
    known = Known(weights.normalisation, spectra)
    for law in (FARM_LAW, SCOUTING_LAW):
        data = farm_test_data(FARMS, CAMERA, law)
        tally = found.setdefault(law, Tally())
        others = [re.sub(r"day-\d+-hour-\d+", f"day-{day}-hour-12", data.train[0]) for day in OTHER_DAYS]
        for number, name in enumerate([*data.train, *others]):
            scene = data.scene(name)
            rng = np.random.default_rng([9, number])
            seen = observe_scene(scene, CAMERA, SceneGrid(*scene.shape, weights.config.patch), weights.basis, rng)
            columns = seen.columns[: scene.shape[0], : scene.shape[1]]
            if name in others:
                tally.found.setdefault("day 20, 340", []).append(known.warns(columns))
                continue
            judge(tally, known, [columns])
            middle = np.median(columns, axis=(0, 1))
            assert seen.noise is not None
            noise = seen.noise.covariance(middle, DARK_MS / CAMERA.exposure_ms)
            tally.alike.append(known.warns(columns + rng.multivariate_normal(0 * middle, noise, columns.shape[:2])))
    return found


def rows() -> list[Row]:
    """Return the rows of the table."""
    folder = data_folder("")
    if not (folder / "cwfid").is_dir():
        return [not_run("notes on unlike scenes", folder)]
    kinds = {**judged_files(folder), **judged_farms()}
    alike = [one for tally in kinds.values() for one in tally.alike]
    shifted = [one for tally in kinds.values() for found in tally.found.values() for one in found]
    found = [
        Row("false alarms on held-out scenes", f"{sum(alike)} of {len(alike)}", "<= 2 %", np.mean(alike) <= 0.02),
        Row("shifts found", f"{np.mean(shifted):.0%} of {len(shifted)}", ">= 60 %", np.mean(shifted) >= 0.6),
    ]
    for kind, tally in kinds.items():
        each = ", ".join(f"{name} {np.mean(one):.0%}" for name, one in tally.found.items())
        found.append(Row(kind, f"{sum(tally.alike)} of {len(tally.alike)} false", peers=each))
    return found


if __name__ == "__main__":
    print_rows(rows())
