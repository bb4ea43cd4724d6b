"""The command line, with the simulated rig rounded as an emulated one is by what lies between it and the survey.

``python -m tests.soak.simulated_as_wired survey ...``: positions are those of the wire, float32, and references are the
means of whole frames of a camera. Raw lines are as they were.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from flows.cli.main import main
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_cubes import as_references, mean_frame
from pipeline.rig.emulator.emulated_rig import REFERENCE_FRAMES, SceneView
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import AT_REST, Line, References

_EXACT_LINES, _EXACT_REFERENCES = SimulatedSource.lines_of, SimulatedSource.references


def lines_of(self: SimulatedSource, sweep: Sweep, numbers: range) -> list[Line]:
    """The lines, from where the wire says that the mirror was."""
    return [
        replace(line, mirror_x=float(np.float32(line.mirror_x)), mirror_y=float(np.float32(line.mirror_y)))
        for line in _EXACT_LINES(self, sweep, numbers)
    ]


def references(self: SimulatedSource, sweep: Sweep) -> References:
    """The references, as means of whole frames."""
    exact = _EXACT_REFERENCES(self, sweep)
    if sweep == AT_REST:  # what the frames are made of
        return exact
    frames = SceneView(self).references((self.camera.exposure_ms, self.camera.frame_ms), REFERENCE_FRAMES)
    dark, white = (mean_frame(frames[f"{name}Reference"]) for name in ("dark", "white"))
    whole = as_references(dark, white, white_reference=exact.white_reference)
    sums = [
        one.reshape(len(one) // sweep.binning, sweep.binning, -1).sum(axis=1, dtype=np.float32)
        for one in (whole.dark, whole.white)
    ]
    return replace(exact, dark=sums[0], white=sums[1])


if __name__ == "__main__":
    SimulatedSource.lines_of, SimulatedSource.references = lines_of, references  # type: ignore[method-assign]
    main(sys.argv[1:])
