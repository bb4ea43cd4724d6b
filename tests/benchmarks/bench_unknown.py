"""Cost of the class unknown on farms that are not in the training data, and its detection rate on other fields.

The farms have other seeds and days than the training of weights and limits. Each is scanned in three ways, and each map
is drawn with the class and without it, from the same lines. Other fields have spectra that no farm has. These are made
up, a farm's in shuffled bands, grey boards, and Indian Pines (AVIRIS, in the data folder) at the farm's brightness.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from measure import Row, data_folder, not_run
from numpy.typing import NDArray
from rich.console import Console

from flows.settings.load import load_settings
from flows.survey_command import run_survey
from flows.tasks.survey_model import shipped_weights
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.scenes.farm.farm_scene import farm_scene

SEEDS = (21, 22, 23)
DAYS = (120, 172, 250)
SIZE = "640x512"
PROBES: dict[str, dict[str, Any]] = {
    "every line, 100 ms": {"scan_step": 1},
    "survey --seconds 25": {"seconds": 25},
    "every line, 5 ms": {"scan_step": 1, "scan_exposure_ms": 5},
}
WEIGHTS = shipped_weights()
BANDS_NM = np.linspace(405.0, 995.0, 60)
PINES = data_folder("indian_pines")
BRIGHTNESS = 0.22  # mean reflectance of farms
Judged = dict[str, float]


def rows() -> list[Row]:
    """Return the unknown pixels of farms and of other fields, in percent: mean (least - most)."""
    found = []
    for name, scan_pass in PROBES.items():
        judged = [_farm(seed, day, scan_pass) for seed in SEEDS for day in DAYS]
        fractions = [100 * one["fraction"] for one in judged]
        found.append(Row(f"farms, {name}: unknown", _figure(fractions, "%"), "<= 1 % each", max(fractions) <= 1))
        change = [one["change"] for one in judged]
        mean = float(np.mean(change))
        found.append(Row(f"farms, {name}: mIoU with it - without", _figure(change, "points"), ">= -0.1", mean >= -0.1))
        spent, without = (sum(one[what] for one in judged) for what in ("cpu_s", "cpu_without_s"))
        more = 100 * (spent / without - 1)
        found.append(Row(f"farms, {name}: processor time of draw_map", f"{more:+.1f} %", "<= 5 %", more <= 5))
        print(*(f"{row.what}: {row.figure}" for row in found[-3:]), sep="\n", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, path in other_fields(Path(folder)):
            for scan_pass in ("every line, 100 ms", "every line, 5 ms"):
                given = {"scene": str(path), "source": "sim", "weights": str(WEIGHTS), **PROBES[scan_pass]}
                fraction = 100 * _survey(given, "auto")["fraction"]
                found.append(Row(f"{name}, {scan_pass}: unknown", f"{fraction:.1f} %", ">= 90 %", fraction >= 90))
                print(f"{found[-1].what}: {found[-1].figure}", flush=True)
    return found if PINES.is_dir() else [*found, not_run("Indian Pines at the farm's brightness", PINES)]


def _figure(values: list[float], unit: str) -> str:
    return f"{np.mean(values):.2f} ({min(values):.2f} - {max(values):.2f}) {unit}"


def _farm(seed: int, day: int, scan_pass: dict[str, Any]) -> Judged:
    """Return a farm's fraction of unknown pixels, its change of mIoU [points], and the processor times of both maps."""
    given = {"scene": "farm", "size": SIZE, "seed": seed, "day": day, **scan_pass}
    with tempfile.TemporaryDirectory() as out:
        without, with_it = (_survey({**given, "out": out}, word) for word in ("off", "auto"))
    change = 100 * (with_it["miou"] - without["miou"])
    return {**with_it, "change": change, "cpu_without_s": without["cpu_s"]}


def _survey(given: dict[str, Any], unknown: str) -> Judged:
    with tempfile.TemporaryDirectory() as out:
        plain = {"engine": "plain", "unknown": unknown, "out": out, **given}
        receipt = run_survey(load_settings(None, plain), Console(quiet=True)).receipt
    miou = receipt.get("accuracy", {}).get("miou")
    return {
        "fraction": float(receipt.get("unknown", {}).get("fraction", 0)),
        "miou": float("nan") if miou is None else miou,
        "cpu_s": next(stage["cpu_s"] for stage in receipt["stages"] if stage["name"] == "segment"),
    }


def other_fields(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield fields with spectra that no farm has, as files with their wavelengths."""
    rng = np.random.default_rng(0)
    middle, width, height = (rng.uniform(*span, (7, 3, 1)) for span in ((400, 1000), (40, 150), (0.05, 0.4)))
    bumps = height * np.exp(-0.5 * ((BANDS_NM - middle) / width) ** 2)  # (spectrum, bump, band)
    invented = np.asarray(bumps.sum(axis=1) + rng.uniform(0.02, 0.1, (7, 1)))
    yield "invented spectra", _written(folder / "invented", _picture(invented, rng), BANDS_NM)
    boards = np.repeat(np.array([0.1, 0.2, 0.35, 0.5, 0.7]), 64)[None, :, None]
    grey = np.broadcast_to(boards, (256, 320, len(BANDS_NM)))
    yield "grey boards", _written(folder / "boards", grey, BANDS_NM)
    farm = farm_scene(SEEDS[0], (256, 320), camera=LineCamera(), day=DAYS[1])
    reflectance = (farm.planes @ farm.electrons / farm.white_reference_electrons * farm.white_reference)[..., ::5]
    for number in range(3):
        shuffled = np.random.default_rng(number).permutation(reflectance.shape[-1])
        place = folder / f"shuffled{number}"
        yield f"farm, bands shuffled ({number})", _written(place, reflectance[..., shuffled], farm.wavelength_nm[::5])
    if PINES.is_dir():
        yield "Indian Pines at the farm's brightness", _pines(PINES, folder / "pines")


def _picture(spectra: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return patches of the spectra with soft shades and edges, like a photograph, (y, x, band)."""
    fields = np.stack([scipy.ndimage.gaussian_filter(rng.standard_normal((256, 320)), 12) for _ in spectra], axis=-1)
    fraction = scipy.special.softmax(400 * fields, axis=-1)
    shade = 1 + 4 * scipy.ndimage.gaussian_filter(rng.standard_normal((256, 320)), 8)[..., None]
    return np.asarray((fraction @ spectra) * np.clip(shade, 0.5, 1.5))


def _pines(source: Path, folder: Path) -> Path:
    """Write the data set scaled to the farm's brightness, with the wavelengths of its bands."""
    values = np.load(source / "Indian_pines_corrected.npy").astype(np.float32)
    lines = (source / "92AV3C.spc").read_text().splitlines()
    head = next(number for number, line in enumerate(lines) if line.split()[:1] and line.split()[0][0].isdigit())
    nm = np.loadtxt(lines, usecols=0, skiprows=head)
    nm = np.delete(nm, np.r_[103:108, 149:163, 219])
    seen = (nm >= 400) & (nm <= 1000)
    return _written(folder, values * (BRIGHTNESS / values[..., seen].mean()), nm)


def _written(folder: Path, values: NDArray[np.floating], wavelength_nm: NDArray[np.floating]) -> Path:
    folder.mkdir()
    np.save(folder / "scene.npy", values.astype(np.float32))
    (folder / "scene.toml").write_text(f"wavelengths_nm = {[round(float(one), 2) for one in wavelength_nm]}\n")
    return folder / "scene.npy"
