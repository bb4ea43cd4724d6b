"""Prefixes of captures hold the whole sweep, whatever its numbers, in a folder's name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.geometry.scan import Sweep
from pipeline.rig.capture.capture_paths import REFERENCES, Announced, announced, capture_prefix
from pipeline.rig.device_settings import check_capture


def test_prefix_of_a_sweep_is_readable() -> None:
    """Short numbers stand there as they are."""
    sweep = Sweep("coarse-0", "coarse", "y", -31.5, 0.5, 96, 16, 16)
    assert capture_prefix(sweep) == "coarse-0_cy-31p5_0p5_96x16x16_0"


def test_every_sweep_comes_back() -> None:
    """To the last bit of its numbers, from any line on, and always as a name that cameras take."""
    rng = np.random.default_rng(0)
    for number in range(300):
        odd = rng.normal(size=2) * 10.0 ** rng.integers(-9, 9, 2)
        strip, start = (float(rng.choice([one, -0.5, -0.0, 7.0, 1e300])) for one in odd)
        turned = Sweep(f"fine-{number:03d}", "fine", "y", strip, start, int(rng.integers(1, 3000)), 4, 4)
        sweep = turned if number % 2 else replace(turned, kind="coarse", along="x")
        told = Announced(sweep, int(rng.integers(sweep.lines)))
        prefix = capture_prefix(*vars(told).values())
        check_capture(1, 1, prefix)
        assert announced(prefix) == told
        assert str(announced(prefix)) == str(told)  # the sign of zero


@pytest.mark.parametrize(
    "prefix", ["", "field", REFERENCES, "a_cx0_0_0x1x1_0", "a_cx0_0_5x1x1_5", "a_cz0_0_5x1x1_0", "a_cx0_0_5x1_0"]
)
def test_other_prefixes_announce_nothing(prefix: str) -> None:
    """Names that others gave, and sweeps that cannot be."""
    assert announced(prefix) is None


@pytest.mark.parametrize("name", ["a b", "é", "x" * 60])
def test_names_that_no_folder_has_are_refused(name: str) -> None:
    """Before anything is sent."""
    with pytest.raises(SettingsError, match="letters, digits"):
        capture_prefix(Sweep(name, "fine", "x", 0.0, 0.0, 5))
