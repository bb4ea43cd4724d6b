"""The detector chain of the readout, put together from Pyxel's own models: one line is one exposure of its detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.counting import dark_electrons
from pipeline.simulator.rig_model import Rig

VOLT_PER_E = 1e-5
MILLISECOND = 1e-3


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
