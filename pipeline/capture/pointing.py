"""Mirror positions of recorded lines: from viewing angles, or from a vector that the mirror played by its own clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.mirror import (
    REST_TANGENT,
    direction_to_normal,
    direction_to_position,
    normal_to_device,
    scene_to_direction,
)

Floats = NDArray[np.float64]
MOST_DEG = 89.0  # an angle beyond which a direction does not look at the scene plane


def angles_to_positions(angles_deg: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Give the mirror positions (line, 2) of viewing angles (line, 2), and whether the mirror reaches them (line,).

    The angles are those between the undeflected direction and the view, projected on the line's axis and on the scan:
    the scene tangents are their tangents. Positions that are not reached are NaN. The mirror turns the view by 50 deg
    along the scan, and by 35.6 deg across it where the scan is at 0.
    """
    positions = np.full(angles_deg.shape, np.nan)
    ahead = (np.abs(angles_deg) < MOST_DEG).all(axis=1)
    direction = scene_to_direction(np.tan(np.deg2rad(angles_deg[ahead])))
    device = normal_to_device(direction_to_normal(direction))
    straight = 2 * device[:, 2] ** 2 - 1  # of the beam that falls along the rest normal, after the reflection
    lateral = 2 * device[:, 2] * np.hypot(device[:, 0], device[:, 1])
    reached = np.zeros(len(angles_deg), np.bool_)
    reached[ahead] = (device[:, 2] > 0) & (straight > 0) & (lateral <= REST_TANGENT * straight)
    positions[reached] = direction_to_position(direction[reached[ahead]])
    return positions, reached


@dataclass(frozen=True)
class PlayedVector:
    """A vector of positions that the mirror played by its own clock while the camera took lines by its own.

    The mirror holds cell k from k / ``rate_hz`` to (k + 1) / ``rate_hz`` seconds after its start, and started
    ``start_s`` before the first line's exposure did (negative: after it).
    """

    position: Floats  # (cell, 2) device X and Y
    rate_hz: float
    start_s: float = 0.0

    def at(self, time_s: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Give the position at mid exposure of lines (line, 2), and whether it was played then (line,).

        ``time_s`` (line,) is that of mid exposure since the first line's exposure began. The cell of a line is
        floor((time_s + start_s) * rate_hz). Before the first and after the last cell stands that cell's position.
        """
        cell = np.floor((time_s + self.start_s) * self.rate_hz)
        played = (cell >= 0) & (cell < len(self.position))
        return self.position[np.clip(cell, 0, len(self.position) - 1).astype(np.intp)], played


def split_vector(values: Floats, where: str) -> Floats:
    """Give (cell, 2) positions of a vector: two columns X and Y, or one column or row with all X before all Y.

    The second is how the mirror's controller keeps both channels in one memory: X in the cells 0 to n - 1 and Y in n to
    2 n - 1.

    Raises SceneError: the numbers are no such vector.
    """
    flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
    if flat.ndim == 2 and flat.shape[1] == 2:
        return flat
    if flat.ndim != 1 or len(flat) % 2 or not len(flat):
        raise SceneError(
            f"{where} holds numbers of shape {values.shape}, expected two columns X and Y, or one column with all X "
            "before all Y; write as many Y as X"
        )
    return np.stack(np.split(flat, 2), axis=-1)
