"""Detector: statistics and time of the readout, beside the same chain of models in Pyxel (package pyxel-sim)."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measure import Clock, Row, ratio, time_in_turn
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera, digitise
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.counting import DARK_CURRENT, QUANTISATION, READ_NOISE, SATURATION, SHOT, dark_electrons
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.noise import normal_deviates, photon_counts, rounded_counts
from pipeline.simulator.effects.noise_loops import read_merged
from pipeline.simulator.effects.sensor import PRNU
from pipeline.simulator.readout import read_out
from pipeline.simulator.rig_model import Detector, Rig

LINES, SAMPLES, BANDS = 16, 640, 270
LEVELS_E = (0.0, 10.0, 50.0, 200.0, 700.0, 2000.0, 5000.0, 10_000.0, 16_000.0, 25_000.0)  # the last overflows
WELL_E = 18_000
RUNS = 3  # of all lines, for the statistics
AGREES_SD = 4.5  # of 2 x 2 x 10 figures, each normal
READOUT_NS = 9.0

Light = NDArray[np.float32]
Raw = NDArray[np.uint16]
VOLT_PER_E = 1e-5
MILLISECOND = 1e-3


def rows() -> list[Row]:
    """Statistics by level, time beside the peer, time of each draw."""
    light = _usual_light()
    calls: dict[str, Callable[[], object]] = {
        "cheap": partial(_ours, light, "gaussian"),
        "exact": partial(_ours, light, "exact"),
        "camera": partial(_digitised, light),
    }
    if importlib.util.find_spec("pyxel") is None:
        peer = [Row("detector chain beside Pyxel", "not run: pip install pyxel-sim")]
        return [*peer, *_own_times(time_in_turn(calls)), *_draws()]
    with tempfile.TemporaryDirectory() as folder:
        theirs = _chain(Path(folder)).read_out
        clocks = time_in_turn(calls | {"pyxel": partial(theirs, light)}, rounds=3)
        agreement = _agreement(theirs)
    return [*agreement, *_beside(clocks), *_own_times(clocks), *_draws()]


def _rig() -> Rig:
    return Rig(detector=Detector(well_e=WELL_E, stripe_share=0.0))


def _usual_light() -> Light:
    """Light as a scene has it, (line, sample, band) [e-]: what is timed."""
    return np.random.default_rng(0).uniform(200, 15_000, (LINES, SAMPLES, BANDS)).astype(np.float32)


def _light_by_level() -> Light:
    """A level for every tenth of the bands, (line, sample, band) [e-]: what is compared."""
    levels = np.repeat(np.array(LEVELS_E, np.float32), BANDS // len(LEVELS_E))
    return np.broadcast_to(levels, (LINES, SAMPLES, BANDS)).copy()


def _block(rig: Rig, seed: int = 0) -> SweepBlock:
    sweep = Sweep("fine", "fine", "x", strip_px=0.0, start_px=0.0, lines=LINES)
    return SweepBlock(rig, sweep, range(LINES), np.linspace(400.0, 1000.0, BANDS), (SAMPLES, SAMPLES), seed=seed)


def _ours(light: Light, variant: str, seed: int = 0) -> Raw:
    block = _block(_rig(), seed)
    chosen: dict[Any, str] = {
        DARK_CURRENT: "exact",
        SHOT: variant,
        READ_NOISE: "exact",
        SATURATION: "exact",
        QUANTISATION: "exact",
    }
    return read_out(light * PRNU.gain(block, "exact"), block, chosen)


def _chain(folder: Path) -> PyxelChain:
    rig, block = _rig(), _block(_rig())
    return PyxelChain(rig, PRNU.gain(block, "exact")[0], folder)


def _digitised(light: Light) -> None:
    """Shot and read noise as training draws them, without dark current, pattern and well."""
    block = _block(_rig())
    for number, line in enumerate(light):
        digitise(line, block.rig.camera, block.stream("shot", number))


def _agreement(theirs: Callable[[Light], Raw]) -> list[Row]:
    """Mean and variance over the lines, averaged over the elements of a level: ours less theirs, in standard errors."""
    np.random.seed(0)  # noqa: NPY002  the peer draws from the global generator
    peer = np.concatenate([theirs(_light_by_level()) for _ in range(RUNS)])
    found = []
    for variant in ("exact", "gaussian"):
        raw = np.concatenate([_ours(_light_by_level(), variant, seed) for seed in range(RUNS)])
        mean, variance, mean_se, variance_se = _by_level(raw)
        peer_mean, peer_variance, peer_mean_se, peer_variance_se = _by_level(peer)
        off_mean = np.abs(mean - peer_mean) / np.hypot(mean_se, peer_mean_se)
        off_variance = np.abs(variance - peer_variance) / np.hypot(variance_se, peer_variance_se)
        worst = max(off_mean.max(), off_variance.max())
        found.append(
            Row(
                f"detector chain, shot {variant}: mean and variance at {len(LEVELS_E)} levels, 0 to 25,000 e-",
                f"{off_mean.max():.1f} and {off_variance.max():.1f} standard errors at most",
                f"<= {AGREES_SD}",
                bool(worst <= AGREES_SD),
                f"Pyxel; at 10,000 e-: mean {mean[7]:.2f} and {peer_mean[7]:.2f} DN,"
                f" variance {variance[7]:.1f} and {peer_variance[7]:.1f} DN^2",
            )
        )
    return found


def _by_level(raw: Raw) -> tuple[NDArray[np.float64], ...]:
    """Mean and variance of each level with their standard errors, (level,) each; the fixed pattern stays out."""
    lines = len(raw)
    split = raw.reshape(lines, SAMPLES, len(LEVELS_E), -1)
    total = np.zeros((2, SAMPLES, len(LEVELS_E), BANDS // len(LEVELS_E)))
    for line in split.astype(np.float64):
        total += line, line**2
    mean = total[0] / lines
    variance = (total[1] / lines - mean**2) * lines / (lines - 1)
    elements = mean.size / len(LEVELS_E)
    by_level = variance.mean(axis=(0, 2))
    mean_se = np.sqrt(by_level / elements / lines)
    return mean.mean(axis=(0, 2)), by_level, mean_se, by_level * np.sqrt(2 / elements / (lines - 1))


def _ns(clock: Clock) -> float:
    return 1e9 * clock.cpu_min_s / (LINES * SAMPLES * BANDS)


def _beside(clocks: dict[str, Clock]) -> list[Row]:
    peer = f"Pyxel: {_ns(clocks['pyxel']):.0f} ns/px*band"
    return [
        Row(
            f"detector chain with wells that overflow, shot {name}: processor time",
            f"{_ns(clocks[call]):.1f} ns/px*band, 1/{(less := ratio(clocks, 'pyxel', call)):.1f} of the peer",
            "no slower",
            less >= 1,
            peer,
        )
        for name, call in (("exact", "exact"), ("gaussian", "cheap"))
    ]


def _own_times(clocks: dict[str, Clock]) -> list[Row]:
    """The default rig, whose converter ends before the wells do: one draw for shot and read noise."""
    block = _block(Rig())
    chosen: dict[Any, str] = {DARK_CURRENT: "exact", SHOT: "gaussian", READ_NOISE: "exact", SATURATION: "exact"}
    usual = time_in_turn({"usual": partial(read_out, _usual_light(), block, chosen)})["usual"]
    return [
        Row(
            "readout of the default rig, 200 to 15,000 e-: processor time",
            f"{_ns(usual):.1f} ns/px*band",
            f"<= {READOUT_NS:g} ns",
            _ns(usual) <= READOUT_NS,
            f"camera.digitise (shot and read noise only): {_ns(clocks['camera']):.1f} ns",
        )
    ]


def _draws() -> list[Row]:
    """What a draw costs, of each kind and generator."""
    count = SAMPLES * BANDS
    light = np.random.default_rng(0).uniform(700, 15_000, count).astype(np.float32)
    philox, sfc = (
        np.random.Generator(source(np.random.SeedSequence(0))) for source in (np.random.Philox, np.random.SFC64)
    )
    deviate, camera = normal_deviates(philox, count), LineCamera()
    calls: dict[str, Callable[[], object]] = {
        "deviates": partial(normal_deviates, philox, count),
        "deviates, SFC64": partial(normal_deviates, sfc, count),
        "numpy ziggurat, Philox": partial(philox.standard_normal, count, dtype=np.float32),
        "numpy ziggurat, SFC64": partial(sfc.standard_normal, count, dtype=np.float32),
        "exact counts": partial(photon_counts, light, deviate),
        "numpy poisson, Philox": partial(philox.poisson, light),
        "numpy poisson, SFC64": partial(sfc.poisson, light),
        "rounded": partial(rounded_counts, light, deviate),
        "merged": partial(
            *(read_merged, light, np.zeros(1, np.float32), deviate, camera.read_noise_e, camera.electrons_per_dn),
            *(camera.dark_dn, camera.full_scale_dn, np.empty(count, np.uint16)),
        ),
    } | _torch_draws(light)
    clocks = time_in_turn(calls, rounds=5)
    ns = {name: f"{1e9 * clock.cpu_min_s / count:.1f}" for name, clock in clocks.items()}
    others = ", ".join(f"{name} {ns[name]}" for name in ns if name.startswith(("numpy ziggurat", "torch normal")))
    counting = ", ".join(f"{name} {ns[name]}" for name in ns if name.startswith(("numpy poisson", "torch poisson")))
    return [
        Row("normal deviates: ns each", f"{ns['deviates']} (SFC64 {ns['deviates, SFC64']})", peers=others),
        Row("exact counts from deviates: ns each", ns["exact counts"], peers=counting),
        Row("cheap counts alone, and with read noise as raw numbers: ns each", f"{ns['rounded']}, {ns['merged']}"),
    ]


def _torch_draws(light: Light) -> dict[str, Callable[[], object]]:
    import torch

    generator, out, mean = torch.Generator(), torch.empty(len(light)), torch.from_numpy(light)
    return {
        "torch normal": lambda: out.normal_(generator=generator),
        "torch poisson": lambda: torch.poisson(mean, generator=generator),
    }


class PyxelChain:
    """Shot noise, dark current, PRNU, full well, read noise, converter, in the order in which Pyxel has them."""

    def __init__(self, rig: Rig, gain: NDArray[np.float32], folder: Path) -> None:
        """Make a detector of the gain's shape; the gain is read from a file, as its model wants it."""
        from pyxel.detectors import CCD, CCDGeometry, Characteristics, Environment

        camera = rig.camera
        step = camera.electrons_per_dn * VOLT_PER_E
        lowest = -(camera.dark_dn + 0.5) * step  # its converter cuts off; half a step more rounds
        self._rig, self._gain = rig, folder / "gain.npy"
        np.save(self._gain, gain.astype(np.float64))
        self._detector = CCD(
            geometry=CCDGeometry(row=gain.shape[0], col=gain.shape[1]),
            environment=Environment(),
            characteristics=Characteristics(
                quantum_efficiency=1.0,
                full_well_capacity=int(rig.detector.well_e),
                adc_bit_resolution=camera.bits,
                adc_voltage_range=(lowest, lowest + camera.full_scale_dn * step),
            ),
        )

    def read_out(self, light: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Turn expected electrons into DN, (line, sample, band)."""
        return np.stack([self._exposed(line) for line in light])

    def _exposed(self, line: NDArray[np.float32]) -> NDArray[np.uint16]:
        from pyxel.models.charge_collection import fixed_pattern_noise, simple_collection, simple_full_well
        from pyxel.models.charge_generation import simple_conversion, simple_dark_current
        from pyxel.models.charge_measurement import output_node_noise, simple_measurement
        from pyxel.models.photon_collection import shot_noise
        from pyxel.models.readout_electronics import simple_adc

        detector, rig = self._detector, self._rig
        seconds = rig.camera.exposure_ms * MILLISECOND
        detector.set_readout(times=[seconds], start_time=0.0, non_destructive=False)
        detector.empty()
        detector.time_step = seconds
        detector.photon.array = line.astype(np.float64)
        shot_noise(detector, type="poisson")
        simple_conversion(detector, binomial_sampling=False)
        simple_dark_current(detector, dark_rate=dark_electrons(rig) / seconds)
        simple_collection(detector)
        fixed_pattern_noise(detector, filename=self._gain)
        simple_full_well(detector)
        simple_measurement(detector, gain=VOLT_PER_E)
        output_node_noise(detector, std_deviation=rig.camera.read_noise_e * VOLT_PER_E)
        simple_adc(detector, data_type="uint16")
        return np.array(detector.image.array, np.uint16)
