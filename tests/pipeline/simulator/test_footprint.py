"""Footprints: moments of what is folded, positive weights of sum 1, and kernels parted without loss."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulator.footprint import AxisKernel, Footprint, fold, quadrature


def moment(footprint: Footprint, axis: int, order: int) -> np.ndarray:
    """Moment (band,) of the rays, axis 0 along and 1 across."""
    place = (footprint.along, footprint.across)[axis]
    return (place[:, None] ** order * footprint.weight).sum(axis=0)


@settings(max_examples=40, deadline=None)
@given(
    box=st.floats(0, 6),
    blur=st.floats(0, 1.5),
    spread=st.floats(0, 1),
    shift=st.floats(-2, 2),
    nodes=st.tuples(st.integers(1, 9), st.integers(1, 6)),
)
def test_moments_of_box_and_blurs_add(
    box: float, blur: float, spread: float, shift: float, nodes: tuple[int, int]
) -> None:
    """Every band has the shift of its blurs, and the variance of box and blurs together."""
    bands = np.linspace(1 - spread, 1, 4)
    variance = blur**2 * np.stack([bands, 2 * bands])
    way = shift * np.stack([bands, -bands])
    found = fold((box, 1.0), nodes, way, variance)
    np.testing.assert_allclose(found.weight.sum(axis=0), 1, atol=1e-9)
    for axis, width in ((0, 1.0), (1, box)):
        np.testing.assert_allclose(moment(found, axis, 1), way[axis], atol=1e-8)
        if len(set((found.along, found.across)[axis].round(9))) > 2:
            total = width**2 / 12 + variance[axis] + way[axis] ** 2
            np.testing.assert_allclose(moment(found, axis, 2), total, rtol=1e-7, atol=1e-7)


def test_boxes_alone_give_legendre_nodes() -> None:
    """Without a blur the rays are those of Gauss and Legendre, the same in all bands."""
    found = fold((2.7, 1.0), (4, 2), np.zeros((2, 3)), np.zeros((2, 3)))
    node, weight = np.polynomial.legendre.leggauss(4)
    np.testing.assert_allclose(found.across[::2], node * 1.35, atol=1e-14)
    np.testing.assert_allclose(found.along[:2], np.array([-0.5, 0.5]) / np.sqrt(3), atol=1e-14)
    np.testing.assert_allclose(found.weight, np.repeat(np.repeat(weight / 4, 2)[:, None], 3, axis=1), atol=1e-14)


def test_a_blur_alone_gives_hermite_nodes() -> None:
    """Without a box three rays are those of Gauss and Hermite: 0 and sqrt(3) sd, weights 2/3 and 1/6."""
    node, weight = AxisKernel(0.0, np.zeros(2), np.full(2, 4.0)).nodes(3)
    np.testing.assert_allclose(node, 2 * np.sqrt(3) * np.array([-1, 0, 1]), atol=1e-12)
    np.testing.assert_allclose(weight[:, 1], [1 / 6, 2 / 3, 1 / 6], atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_are_their_own_quadrature(count: int) -> None:
    """As many nodes as points, or more, give the points back."""
    place = np.arange(count) * 1.5 - 2
    node, weight = quadrature(place, np.full(count, 1 / count), 8)
    np.testing.assert_allclose(node, place, atol=1e-9)
    np.testing.assert_allclose(weight, 1 / count, atol=1e-9)


def test_a_slit_of_no_width_is_one_ray() -> None:
    """A zero-width slit without blur takes one ray across."""
    found = fold((0.0, 1.0), (4, 2), np.zeros((2, 1)), np.zeros((2, 1)))
    np.testing.assert_array_equal(found.across, 0.0)
    assert len(found.across) == 2


def test_one_kernel_is_exact_to_the_double_degree() -> None:
    """Five rays integrate the ninth degree over box and Gaussian: their eighth moment."""
    variance = np.full(3, 0.3)
    node, weight = AxisKernel(2.0, np.zeros(3), variance).nodes(5)
    gauss, share = np.polynomial.hermite_e.hermegauss(20)
    box = np.linspace(-1, 1, 20001)
    wanted = np.mean((box[:, None] + gauss * np.sqrt(0.3)) ** 8 @ (share / share.sum()))
    assert (node**8 @ weight)[1] == pytest.approx(wanted, rel=2e-4)


def test_kernels_hold_all_bands_with_few_parts() -> None:
    """Seventy bands with a blur of their own part into a few kernels that give the weights back."""
    variance = np.linspace(0.02, 0.2, 70)[None] * np.array([[1.0], [2.0]])
    shift = np.stack([np.linspace(-0.1, 0.1, 70), np.zeros(70)])
    found = fold((2.7, 1.0), (5, 3), shift, variance)
    rays, bands = found.kernels()
    assert rays.shape[1] < 10
    np.testing.assert_allclose(rays @ bands, found.weight, atol=3e-5)
    assert fold((2.7, 1.0), (5, 3), np.zeros((2, 70)), np.zeros((2, 70))).kernels()[1].shape == (1, 70)
