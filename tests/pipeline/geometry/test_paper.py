"""Figures of the errata E1 to E18, E22 and E23: the paper's value next to the right one."""

from __future__ import annotations

import numpy as np
import pytest

from spectralzoom.pipeline.geometry import mirror
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep, device_range, memory_loads
from tests.pipeline.geometry.paper_equations import (
    LINE_MODELS,
    line_points,
    line_rotation,
    paper_numbers,
    straight_slope_rotation,
    unlimited_position,
)
from tests.pipeline.geometry.test_mirror import E1, E3, tilted

CAMERA = LineCamera()
IFOV = CAMERA.ifov_rad
SCAN_PX = np.linspace(-640, 640, 1450)  # of the lines of a straight scan


def paper_position(normal: np.ndarray) -> np.ndarray:
    """Return equation (7), X = n_x / sin 25 deg [E2]. It errs by up to 6.40 deg (1056 px) between rest and rim."""
    return mirror.normal_to_device(normal)[..., :2] / np.sin(np.deg2rad(25.0))


def slope_rotation(position: np.ndarray) -> np.ndarray:
    """Return the paper's rotation of a path (line, 2), -atan(dY/dX); NaN at repeated positions [E8, E9]."""
    step = np.diff(position, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return -np.arctan(step[:, 1] / step[:, 0])


def paper_normal(direction: np.ndarray) -> np.ndarray:
    """Return equation (4), in the paper's frame [E7]: c = sqrt((o_z + 1) / 2), a = o_x / 2c, b = o_y / 2c."""
    c = np.sqrt((direction[..., 2] + 1) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([direction[..., 0] / (2 * c), direction[..., 1] / (2 * c), c], axis=-1)


def stable_normal(direction: np.ndarray) -> np.ndarray:
    """Return the same normal as (o_x, o_y, 1 + o_z) / norm, with 1 + o_z free of cancellation [E7]."""
    o = direction.copy()
    z = o[..., 2]
    o[..., 2] = np.where(z < 0, (o[..., 0] ** 2 + o[..., 1] ** 2) / (1 - np.minimum(z, 0)), 1 + z)
    o /= np.abs(o).max(axis=-1, keepdims=True)
    return o / np.sqrt(np.sum(o**2, axis=-1, keepdims=True))


def optical_deg(position: np.ndarray) -> float:
    """Return the device's deflection along X. [deg]"""
    return float(np.rad2deg(np.arctan(position[0] * mirror.REST_TANGENT)))


def aim(xi_px: object, eta_px: object) -> np.ndarray:
    """Return exact positions that look at scene points, also beyond the rim."""
    tangents = np.stack(np.broadcast_arrays(xi_px, eta_px), axis=-1) * IFOV
    return unlimited_position(mirror.direction_to_normal(mirror.scene_to_direction(tangents)))


def viewed(position: np.ndarray) -> np.ndarray:
    """Return the scene points (xi, eta) that positions look at. [px]"""
    return mirror.direction_to_scene(mirror.position_to_direction(position)) / IFOV


def turn_of(position: np.ndarray) -> np.ndarray:
    """Return the exact rotation of the line at positions. [rad]"""
    return line_rotation(mirror.position_to_direction(position))


@pytest.mark.parametrize(
    ("tilt", "x", "eq7", "error_deg", "error_px", "product_deg", "product_px"),
    [
        (1, 0.0293, 0.0413, 0.82, 135, -1.00, -165),
        (5, 0.1480, 0.2062, 3.81, 629, -5.04, -832),
        (10, 0.3054, 0.4109, 6.09, 1005, -10.3, -1700),
        (12.56, 0.3934, 0.5146, 6.40, 1056, -13.1, -2169),
        (20, 0.7041, 0.8093, 3.96, 654, -22.2, -3662),
        (25, 1.0, 1.0, 0.0, 0, -29.0, -4795),
    ],
)
def test_e1_e2_positions_differ_as_tabulated(tilt, x, eq7, error_deg, error_px, product_deg, product_px):
    """Equation (7), published code, and equation (1) read with the tilt err against the device's coordinate."""
    normal = tilted(tilt)
    px = np.deg2rad(1) / IFOV
    assert [mirror.normal_to_position(normal)[0], paper_position(normal)[0]] == pytest.approx([x, eq7], abs=6e-5)
    off = optical_deg(paper_position(normal)) - 2 * tilt
    assert [off, off * px] == pytest.approx([error_deg, error_px], abs=0.5 if off > 9 else 0.6)
    assert off == pytest.approx(error_deg, abs=0.006)
    device = mirror.normal_to_device(normal)
    off = (
        optical_deg(device[2] * device[:2] / mirror.REST_TANGENT) - 2 * tilt
    )  # n_x n_z / tan 50 deg, as in published code
    assert off == pytest.approx(product_deg, abs=0.06)
    assert off * px == pytest.approx(product_px, abs=0.6)
    mechanical = device[:2] / device[2] / mirror.REST_TANGENT  # equation (1), with theta as the mirror's own tilt
    assert optical_deg(mechanical) == pytest.approx(tilt, abs=1e-12)


def test_e2_equation_7_moves_too_far():
    """Equation (7) turns 100 px into 141 and 1280 px along the line into 1792; xi 4800 reaches (5479, 163)."""
    reached = {
        asked: viewed(paper_position(mirror.direction_to_normal(mirror.scene_to_direction(np.array(asked) * IFOV))))
        for asked in ((100, 0), (0, 100), (0, 1280), (4800, 0))
    }
    assert reached[100, 0][0] == pytest.approx(141, abs=0.5)
    assert reached[0, 100] == pytest.approx([0, 141], abs=0.5)
    assert reached[0, 1280] == pytest.approx([0, 1792], abs=0.6)
    assert reached[4800, 0] == pytest.approx([5479, 163], abs=0.5)


def test_e3_the_corner_of_the_field_is_out_of_reach():
    """In 10240 x 10240 px the corner needs radius 1.029, (4800, 5120) 0.965; 0.06 % of the field is out of reach."""
    assert np.hypot(*aim(5120, 5120)) == pytest.approx(1.029, abs=5e-4)
    assert np.hypot(*aim(4800, 5120)) == pytest.approx(0.965, abs=5e-4)
    side = np.linspace(-5120, 5120, 401)
    assert np.mean(np.linalg.norm(aim(side[:, None], side[None, :]), axis=-1) > 1) == pytest.approx(6e-4, abs=1e-4)


def test_e4_the_papers_matrix_reverses_the_ray():
    """With the normal of equation (4) R i = -o, because i and o point away from the mirror: o = (2 n n^T - I) i."""
    o = mirror.scene_to_direction([[0.2, -0.4], [0.0, 0.0], [-0.5, 0.6]])
    n = paper_normal(o)
    turned = (np.eye(3) - 2 * n[..., :, None] * n[..., None, :]) @ [0.0, 0.0, 1.0]
    assert turned == pytest.approx(-o, abs=1e-15)


def test_e5_the_rotation_by_45_degrees_fits_one_side_only():
    """The rest normal becomes (0, 0, 1) only with the scene on the -x side; for +x it becomes (1, 0, 0)."""
    half = np.sqrt(0.5)
    turn = np.array([[half, 0.0, half], [0.0, 1.0, 0.0], [-half, 0.0, half]])
    assert turn @ [-half, 0, half] == pytest.approx([0, 0, 1], abs=1e-15)
    assert turn @ [half, 0, half] == pytest.approx([1, 0, 0], abs=1e-15)


@pytest.mark.parametrize(("grazing", "view_px"), [(1e-2, 1.65), (1e-3, 454.0), (1e-4, np.inf)])
def test_e7_equation_4_loses_its_digits_at_grazing(grazing: float, view_px: float):
    """The float32 view errs by 1.6 px at 10 mrad, 454 px at 1 mrad, not finite at 0.1 mrad; the stable form holds."""
    turn = np.linspace(0, 2 * np.pi, 500)
    o = np.stack([np.sin(grazing) * np.cos(turn), np.sin(grazing) * np.sin(turn), np.full(500, -np.cos(grazing))], -1)
    single = o.astype(np.float32)
    exact = stable_normal(o.astype(np.float32).astype(np.longdouble))
    off = 2 * np.linalg.norm((paper_normal(single) - exact).astype(np.float64), axis=-1).max() / IFOV
    assert np.nan_to_num(off, nan=np.inf, posinf=np.inf) == pytest.approx(view_px, rel=0.01)
    assert np.linalg.norm(stable_normal(single) - exact, axis=-1).max() < 1.6e-7
    exact = stable_normal(o.astype(np.longdouble))
    assert 2 * np.linalg.norm((paper_normal(o) - exact).astype(np.float64), axis=-1).max() / IFOV < 6e-5


@pytest.mark.parametrize(
    ("position", "psi_deg", "seed_deg"),
    [
        ((0, 0.3), 13.8, 10.4),
        ((0.4, 0.3), 10.8, 7.6),
        ((-0.4, 0.3), 16.7, 11.3),
        ((0.8, 0.3), 8.5, 4.9),
        ((-0.8, 0.3), 18.9, 10.3),
        ((0, 0.7), 27.1, 25.3),
        ((-0.4, 0.8), 34.2, 28.6),
    ],
)
def test_e8_rotation_and_path_slope_differ_at_seven_positions(position, psi_deg: float, seed_deg: float):
    """The exact rotation of the line and the paper's slope of the path have the tabulated values, to 0.06 deg."""
    xi, eta = viewed(np.array(position))
    assert np.rad2deg(turn_of(np.array(position))) == pytest.approx(psi_deg, abs=0.06)
    assert np.rad2deg(straight_slope_rotation(xi, eta, CAMERA)) == pytest.approx(seed_deg, abs=0.06)


def test_e8_the_slope_errs_by_up_to_twelve_and_a_half_degrees():
    """The slope is 1/sqrt 2 of the rotation near the axis. It errs by 4.4 deg within 25 deg, 12.5 deg in the disk."""
    side = np.linspace(-1, 1, 201)
    position = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(position, axis=-1)
    position, radius = position[radius <= 1], radius[radius <= 1]
    xi, eta = viewed(position).T
    off = np.rad2deg(np.abs(straight_slope_rotation(xi, eta, CAMERA) - turn_of(position)))
    assert off.max() == pytest.approx(12.5, abs=0.06)
    assert off[radius <= np.tan(np.deg2rad(25)) / mirror.REST_TANGENT].max() == pytest.approx(4.4, abs=0.06)
    assert straight_slope_rotation(1.0, 0.0, CAMERA) / turn_of(aim(1.0, 0.0)) == pytest.approx(0.7071, abs=1e-4)


def test_e8_the_slope_is_ill_conditioned():
    """40 urad of noise: 47 deg rms by slope, 1.8e-2 px by position; %.6f: 1.6 px by slope, 7.5e-5 px by position."""
    exact = aim(1000.0, SCAN_PX)
    normal = mirror.direction_to_normal(mirror.position_to_direction(exact))
    shaken = normal + np.random.default_rng(0).normal(0, 40e-6, normal.shape)
    noisy = mirror.normal_to_position(shaken / np.linalg.norm(shaken, axis=-1, keepdims=True))

    def rms(of: np.ndarray) -> float:
        return float(np.sqrt(np.mean(of**2)))

    def by_slope(path: np.ndarray) -> float:
        return rms(slope_rotation(path) - slope_rotation(exact))

    def by_pose(path: np.ndarray) -> float:
        return 320 * rms(turn_of(path) - turn_of(exact))

    rounded = np.round(exact, 6)
    assert np.rad2deg(by_slope(noisy)) == pytest.approx(47, abs=2)
    assert np.rad2deg(by_slope(rounded)) == pytest.approx(0.29, abs=0.02)
    assert 320 * by_slope(rounded) == pytest.approx(1.6, abs=0.1)
    assert by_pose(noisy) == pytest.approx(1.8e-2, abs=2e-3)
    assert by_pose(rounded) == pytest.approx(7.5e-5, abs=5e-6)


@pytest.mark.parametrize(("xi_px", "seed_deg", "psi_deg"), [(0, 90.0, 0.0), (500, 87.9, 3.0), (2365, 79.7, 13.6)])
def test_e9_the_slope_is_vertical_on_the_rigs_own_path(xi_px: float, seed_deg: float, psi_deg: float):
    """With the axes of published code the scan runs along Y: -atan(dY/dX) is near 90 deg, but lines hardly turn."""
    mounted = mirror.Mounting(axes="y,-x").to_device(aim(xi_px, np.array([-0.5, 0.5])))
    assert np.abs(np.rad2deg(slope_rotation(mounted))) == pytest.approx(seed_deg, abs=0.06)
    assert np.rad2deg(turn_of(aim(xi_px, 0.0))) == pytest.approx(psi_deg, abs=0.06)


def test_e9_repeated_positions_have_no_slope():
    """At four decimals 313 of 1450 positions repeat the previous one: the slope is 0/0, and atan2 returns 0."""
    path = np.round(aim(0.0, SCAN_PX), 4)
    step = np.diff(path, axis=0) + 0.0  # no negative zeros
    angle = slope_rotation(path)
    assert int(np.isnan(angle).sum()) == int((step == 0).all(axis=1).sum()) == 313
    assert (np.arctan2(step[:, 1], step[:, 0])[np.isnan(angle)] == 0).all()
    assert np.isfinite(turn_of(path)).all()


def test_e11_speed_needs_the_pitch_and_the_frame_period():
    """Equation (8) with the whole sensor gives 640 times the speed. The mirror's rates are 1/2 and 1/sqrt 2 of it."""
    sensor_mm = CAMERA.samples * CAMERA.pitch_um * 1e-3
    paper = sensor_mm / CAMERA.focal_length_mm * 30.0 / (CAMERA.exposure_ms * 1e-3)
    assert paper / (IFOV * 30.0 / (CAMERA.frame_ms * 1e-3)) == pytest.approx(640)
    for tilt, axis in ((IFOV / 2 * E1, 1), (IFOV / np.sqrt(2) * np.array([0.0, 1, 0]), 0)):
        moved = mirror.position_to_direction(mirror.normal_to_position((E3 + tilt) / np.linalg.norm(E3 + tilt)))
        assert np.abs(mirror.direction_to_scene(moved) / IFOV)[axis] == pytest.approx(1, abs=1e-6)


def test_e12_e13_rates_are_in_hertz_and_times_include_readout():
    """m / t_img in ms is 1000 times too small for Hz. 640 x 600 at 100 ms takes 60 s, plus the readout."""
    imaging_ms = 600 * CAMERA.exposure_ms  # equation (10)
    assert imaging_ms == 60_000 == 1e3 * CAMERA.scan_seconds(600)
    assert (1500 / CAMERA.scan_seconds(600)) / (1500 / imaging_ms) == pytest.approx(1000)  # Hz over equation (9)
    assert 1e3 * LineCamera(exposure_ms=100, readout_ms=5).scan_seconds(600) - imaging_ms == pytest.approx(3000)


def test_e14_vector_memory_ranges_are_half_open():
    """Published cells 1451..2900 start a sample late or end beyond the written ones; half-open ranges do neither."""
    last = {"exclusive": 0, "inclusive": 1}  # published code plays X from cells 0..n and Y from n + 1..2n of 2n written
    y = {ends: range(1451, 2900 + more) for ends, more in last.items()}
    assert (len(y["exclusive"]), y["exclusive"][0], y["inclusive"][-1]) == (1449, 1451, 2900)
    assert pytest.approx(0.44, abs=0.002) == 640 / 1450
    (load,) = memory_loads([Sweep("a", "fine", "x", 0.0, 0.0, 1450)], 1500)
    assert load.parts[0].lines == (0, 1450)
    ours_y = (1450, 2900)  # behind X
    assert device_range(ours_y, "inclusive") == (1450, 2899)
    assert device_range(ours_y, "exclusive") == (1450, 2900)


def test_e15_the_slit_spans_lines():
    """A slit of 20 um is 2.70 px along the scan, so lines 1 px apart overlap 2.7 times."""
    assert CAMERA.slit_px == pytest.approx(2.70, abs=0.005)


def test_e17_the_full_scan_takes_hours():
    """163 840 lines: 4.55 h at 100 ms or 27 min at 10 ms, 56.6 GB at 270 bands, 110 loads of 1500 positions."""
    lines = 16 * 10240
    assert lines == 163_840
    assert CAMERA.scan_seconds(lines) / 3600 == pytest.approx(4.55, abs=0.005)
    assert LineCamera(exposure_ms=10).scan_seconds(lines) / 60 == pytest.approx(27.3, abs=0.05)
    assert lines * CAMERA.samples * 270 * 2 / 1e9 == pytest.approx(56.6, abs=0.05)
    assert -(-lines // CostModel().vector_pairs) == 110
    assert CAMERA.scan_seconds(lines) / CAMERA.scan_seconds(lines // 4) == 4


def test_e18_patch_counts_and_patch_numbers_follow_the_formula():
    """256 coarse and 100 to 500 fine patches are 356 to 756. Coarse patches of 4 have numbers 5 apart: 21, 26."""
    assert [(512 // 32) ** 2 + fine for fine in (100, 200, 300, 400, 500)] == [356, 456, 556, 656, 756]
    # 4 columns of coarse patches of 2 x 2 patches; patches 4 and 5 are the first two of the second row.
    coarse = np.array([[2.0, 0.0], [2.0, 2.0]]) + 1.0
    assert paper_numbers(coarse, fine=False, columns=4, factor=2).tolist() == [21, 26]


TABLE_3_TA = {58.85: (53.12, 52.80, 52.87, 53.17, 54.66), 58.70: (58.29, 55.59, 58.62, 58.48, 59.06)}  # by baseline
TABLE_2_SA_256 = {22.62: (18.60, 21.09, 20.91, 22.38, 20.39)}


def above_baseline(table: dict[float, tuple[float, ...]]) -> list[float]:
    """Return mIoU of all rows minus that of the coarse baseline of their section, ascending [points]."""
    return sorted(row - baseline for baseline, rows in table.items() for row in rows)


def test_e22_the_trainable_policy_is_below_its_own_baseline():
    """In table III one of ten rows is above the coarse image alone, by 0.36 points; the worst is 6.05 below."""
    found = above_baseline(TABLE_3_TA)
    assert sum(row < 0 for row in found) == 9
    assert (found[0], found[-1]) == pytest.approx((-6.05, 0.36))


def test_e23_the_static_policy_is_below_its_baseline_at_256_px():
    """All five rows of table II are, by 0.24 to 4.02 points."""
    found = above_baseline(TABLE_2_SA_256)
    assert (found[0], found[-1]) == pytest.approx((-4.02, -0.24))


@pytest.mark.parametrize(
    ("field_deg", "px"),
    [
        (5, (19.9, 6.0, 1.9, 0.67)),
        (10, (40, 12.9, 6.4, 1.37)),
        (25, (111, 47, 39, 3.9)),
        (40, (217, 130, 119, 8.0)),
        (50, (337, 243, 227, 13.3)),
    ],
)
def test_line_models_err_as_in_the_table(field_deg: float, px: tuple[float, ...]):
    """Over a disk to ``field_deg`` along X the exact rotation with the local scale (L3) errs; exact rays do not."""
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    radius = np.tan(np.deg2rad(field_deg)) / mirror.REST_TANGENT * np.array([1.0, 0.8, 0.4])
    position = radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    errors = np.zeros(len(LINE_MODELS))
    for swath, centre in viewed(position.reshape(-1, 2)):
        points = [line_points(model, swath, np.array([centre]), CAMERA) for model in LINE_MODELS]
        off = [np.hypot(a - points[-1][0], b - points[-1][1]).max() for a, b in points]
        errors = np.maximum(errors, off)
    assert errors[:4] == pytest.approx(px, rel=0.012)
    assert errors[4] == 0


def test_lines_turn_and_stretch_over_the_field():
    """Over 10240 x 10240 px psi is 14.5 deg on average and 37.0 at most, mean tan 0.265; the stretch reaches 1.26."""
    side = np.linspace(-5120, 5120, 257)
    direction = mirror.scene_to_direction(np.stack(np.meshgrid(side, side), axis=-1) * IFOV)
    psi = np.abs(line_rotation(direction))
    normal = mirror.direction_to_normal(direction)
    assert np.rad2deg([psi.mean(), psi.max()]) == pytest.approx([14.5, 37.0], abs=0.06)
    assert np.tan(psi).mean() == pytest.approx(0.265, abs=5e-4)
    assert (0.5 / np.abs(normal[..., 0] * normal[..., 2])).max() == pytest.approx(1.26, abs=0.005)


def test_six_decimals_are_enough_to_point():
    """A step of 1e-6 in X or Y moves the view by at most 0.0115 px."""
    rest = mirror.direction_to_position(mirror.scene_to_direction([0.0, 0.0]))
    step = [np.linalg.norm(viewed(rest + d) - viewed(rest)) for d in ((1e-6, 0.0), (0.0, 1e-6))]
    assert step == pytest.approx([1e-6 * mirror.REST_TANGENT / IFOV, 1e-6 * 0.8427 / IFOV], rel=1e-3)
    assert max(step) < 0.0115
