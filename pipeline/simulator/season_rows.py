"""Rows of a field of ``farm@2``: how far each pixel lies from its row, headlands, gaps, wheel marks, rows' shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.farm_fields import Ground
from pipeline.simulator.farm_layout import Field, Points, edge, stripes
from pipeline.simulator.farm_plan import FieldPlan
from pipeline.simulator.farm_sun import Sun, row_shift

Floats = NDArray[np.float64]
PASS_ROWS = 8  # sown at a time; each pass lies a little aside
PASS_SD = 0.03  # of the period
PIECE_PX = 14.0  # a gap is 0.15 of this to all of it, short ones oftener


@dataclass(frozen=True)
class Rows:
    """Pixels against the rows, (n,) each; on headlands rows run along the field's end.

    ``across`` and ``along`` are distances in the field's own frame, ``place`` the distance across the rows where the
    pixel is, ``onward`` along them, ``ends`` to the nearest end of the field [px], ``normal`` (n, 2) across the rows.
    """

    across: Floats
    along: Floats
    ends: Floats
    place: Floats
    onward: Floats
    normal: Points


def rows_of(rng: np.random.Generator, field: FieldPlan, centres: Points) -> Rows:
    """Lay a field's rows; ``rng`` gives how far each pass of the drill lies aside."""
    angle = np.deg2rad(field.row_angle_deg)
    normal, ahead = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
    across, along = centres @ normal + field.row_phase_px, centres @ ahead
    ends, end_normal = np.full(len(centres), 1e4), np.tile(normal, (len(centres), 1))
    for ny, nx, offset in field.parcel.cuts:
        if abs(ahead @ (ny, nx)) > 0.7:
            distance = centres @ np.array([ny, nx]) - offset
            nearer = distance < ends
            ends[nearer], end_normal[nearer] = distance[nearer], (ny, nx)
    aside = rng.normal(0, PASS_SD * field.row_period_px, 512)
    passes = np.floor(across / (PASS_ROWS * field.row_period_px) - 0.5 / PASS_ROWS).astype(int)
    turned = ends < field.headland_px
    place = np.where(turned, ends, across + aside[passes % 512])
    normals = np.where(turned[:, None], end_normal, normal)
    return Rows(across, along, ends, place, np.where(turned, across, along), normals)


def row_gaps(salt: int, field: FieldPlan, rows: Rows, here: Ground) -> Field:
    """Share of each pixel where nothing came up: pieces of rows, more of them where vigour is poor."""
    number = np.rint(rows.place / field.row_period_px).astype(np.int64)
    position = rows.onward / PIECE_PX + _scatter(number, number, salt)
    piece = np.floor(position).astype(np.int64)
    inside = (position - piece) * PIECE_PX
    length = PIECE_PX * (0.15 + 0.85 * _scatter(number, piece, salt + 1) ** 2)
    fails = _scatter(number, piece, salt + 2) < field.gap_rate * np.clip(1 - 0.6 * here.vigour, 0.2, 3)
    onto = np.abs(rows.place - number * field.row_period_px) / field.row_period_px  # 0 on the row, 0.5 between rows
    return np.asarray(edge(np.minimum(inside, length - inside)) * fails * np.clip(2.2 - 3.4 * onto, 0, 1), np.float32)


def row_shadow(sun: Sun, height: float, rows: Rows, period: float, width: Floats) -> Field:
    """Share of each pixel in the shadow of rows of a height, outside the rows themselves."""
    room = np.maximum(period - width, 0)
    shift = np.clip(row_shift(sun, height, rows.normal), -room, room)
    both = stripes_of(rows.place - shift / 2, period, width + np.abs(shift))
    return np.asarray(np.clip(both - stripes_of(rows.place, period, width), 0, 1), np.float32)


def stripes_of(place: Floats, period: float, width: Floats) -> Field:
    """Share of each pixel covered by stripes whose width differs from pixel to pixel (``farm_layout.stripes``)."""
    start = place + (width - 1) / 2
    whole, rest = np.divmod(start, period)
    last, left = np.divmod(start + 1, period)
    return np.asarray((last - whole) * width + np.minimum(left, width) - np.minimum(rest, width), np.float32)


def wheel_marks(field: FieldPlan, rows: Rows) -> Field:
    """Share of each pixel under tramlines, which also go round on the headland; 0 where the field has none."""
    trams = field.tramlines
    if trams is None:
        return np.zeros(len(rows.across), np.float32)
    shift = rows.across + trams.shift
    pair = stripes(shift, trams.spacing, trams.width) + stripes(shift + trams.gauge, trams.spacing, trams.width)
    middle = field.headland_px / 2
    turn = edge(trams.width / 2 - np.abs(np.abs(rows.ends - middle) - trams.gauge / 2))
    inner = edge(rows.ends - middle - trams.gauge / 2)
    return np.asarray(np.clip(np.maximum(pair * inner, turn), 0, 1), np.float32)


def _scatter(first: NDArray[np.int64], second: NDArray[np.int64], salt: int) -> Floats:
    """Evenly spread numbers from 0 to below 1 that only depend on what is given (integer hash)."""
    mixed = first.astype(np.uint32) * np.uint32(0x9E3779B1) ^ second.astype(np.uint32) * np.uint32(0x85EBCA6B)
    mixed ^= np.uint32((salt * 0xC2B2AE35) & 0xFFFFFFFF)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        mixed = (mixed ^ (mixed >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray(mixed ^ (mixed >> np.uint32(16)), np.float64) / 2**32
