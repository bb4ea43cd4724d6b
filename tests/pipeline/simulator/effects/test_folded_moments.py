"""Adding variances: right to the fourth moment, and the bounds of blur and shift against the figures of the design."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j1

from tests.pipeline.simulator.fine_image import ALONG, BOX, IMAGES, SCAN, convolved, disc, gaussian, probe_of, shifted

# Transfer functions of unit variance at the angular frequency w, and their fourth moments less that of a Gaussian.
KERNELS: dict[str, tuple[Callable[[float], float], float]] = {
    "disc": (lambda w: float(2 * j1(2 * w) / (2 * w)) if w > 1e-9 else 1.0, -1.0),
    "box": (lambda w: float(np.sinc(np.sqrt(3) * w / np.pi)), -1.2),
}


@pytest.mark.parametrize("name", KERNELS)
@given(st.floats(0, 12), st.floats(0.05, 3))
def test_one_kernel_as_a_gaussian(name: str, wave: float, sd: float):
    """On a sine the error is at most C4 times the missing fourth moment over 24: C4 s^4 / 24 for a disc."""
    kernel, excess = KERNELS[name]
    error = abs(kernel(wave * sd) - np.exp(-((wave * sd) ** 2) / 2))
    assert error <= wave**4 * abs(excess) * sd**4 / 24 + 1e-12


@pytest.mark.parametrize("name", KERNELS)
def test_the_fourth_moment_is_what_is_missing(name: str):
    """For small blurs the error is that much exactly: halving the blur takes it to a sixteenth."""
    kernel, excess = KERNELS[name]
    for size in (0.2, 0.1):
        error = np.exp(-(size**2) / 2) - kernel(size)
        assert error == pytest.approx(-excess * size**4 / 24, rel=0.02)


@given(st.lists(st.tuples(st.sampled_from(sorted(KERNELS)), st.floats(0, 1)), min_size=1, max_size=4), st.floats(0, 9))
def test_several_kernels_as_one_gaussian(blurs: list[tuple[str, float]], wave: float):
    """Errors of folded kernels add up at most: none of the transfer functions exceeds 1."""
    product = np.prod([KERNELS[name][0](wave * sd) for name, sd in blurs])
    folded = np.exp(-(wave**2) * sum(sd**2 for _, sd in blurs) / 2)
    allowed = sum(wave**4 * abs(KERNELS[name][1]) * sd**4 / 24 for name, sd in blurs)
    assert abs(product - folded) <= allowed + 1e-12


@pytest.mark.parametrize("name", ["edges", "texture"])
def test_folding_in_the_image(name: str):
    """Defocus of 1 x 0.7 px, 0.4 px of smear and 0.2 px of lens fold within C4 s^4 / 24 of the real convolution."""
    image = IMAGES[name]()
    apart = disc(1.0, 0.7) * np.sinc(0.4 * SCAN) * gaussian(0.2, 0.2)
    folded = gaussian(*np.sqrt([1 / 16 + 0.04, 0.49 / 16 + 0.16 / 12 + 0.04]))
    error = np.abs(convolved(image, BOX * (apart - folded))).max()
    along, scan = 1 / 16, 0.49 / 16  # variance of the disc
    missing = (along**2, 2 * along * scan, scan**2 + 1.2 * (0.16 / 12) ** 2)  # fourth moments less a Gaussian's
    waves = (ALONG**4, (ALONG * SCAN) ** 2, SCAN**4)
    bends = [np.abs(convolved(image, BOX * (2 * np.pi) ** 4 * wave)).max() for wave in waves]
    assert 0 < error <= np.dot(bends, missing) / 24


@pytest.mark.parametrize(
    ("transfer", "bounded", "error", "bound"),
    [
        (np.sinc(0.375 * SCAN), ("blur", 0, 0.375**2 / 12), 0.013, 0.0135),
        (np.sinc(1.125 * SCAN), ("blur", 0, 1.125**2 / 12), 0.046, 0.121),
        (gaussian(0.1, 0.1), ("blur", 0.01, 0.01), 0.0283, 0.0280),
        (gaussian(0.35, 0.35), ("blur", 0.35**2, 0.35**2), 0.114, 0.34),
        (shifted(0, 0.1), ("shift", 0.1, 0.1), 0.038, 0.089),
    ],
    ids=["smear 0.375", "smear 1.125", "blur 0.1", "blur 0.35", "shift 0.1"],
)
def test_pairs_of_the_design(transfer: np.ndarray, bounded: tuple[str, float, float], error: float, bound: float):
    """Edges of contrast 1 and 0.51 behind the slit: measured errors and bounds near those of the design's own image."""
    image = IMAGES["edges"]()
    probe = probe_of(image)
    kind, along, scan = bounded
    found = probe.moved(along, scan) if kind == "shift" else probe.blurred(np.array([[along], [scan]]))
    measured = float(np.abs(convolved(image, BOX * (transfer - 1))).max())
    assert measured <= found
    assert found == pytest.approx(bound, rel=0.1)
    assert measured == pytest.approx(error, rel=0.35)
