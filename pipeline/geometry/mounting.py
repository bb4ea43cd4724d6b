"""How the mirror is mounted: calibration data between the XY that a device takes and the XY of the model.

The paper leaves out which axis of the device is which and which way it turns (erratum E6). Nothing here knows a unit:
the default is the model's own axes, tagged "assumed".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, SettingsError
from pipeline.geometry.mirror import check_reach

Signs = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Mounting:
    """Device XY = axes @ rotation(clocking_deg) @ model XY + offset.

    ``axes`` is a signed permutation: ((0, 1), (-1, 0)) says that the device's X is the model's Y and its Y the model's
    -X. ``clocking_deg`` is the small turn of the mirror about its rest normal, anticlockwise from X to Y, and
    ``offset`` the device's XY at the model's rest.
    """

    axes: Signs = ((1, 0), (0, 1))
    clocking_deg: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    provenance: str = "assumed"

    def __post_init__(self) -> None:
        signs = np.array(self.axes)
        if signs.shape != (2, 2) or not np.array_equal(signs @ signs.T, np.eye(2)):
            raise SettingsError(
                f"mounting axes must be a signed permutation such as ((0, 1), (-1, 0)), got {self.axes}"
            )
        if not np.isfinite([self.clocking_deg, *self.offset]).all():
            raise SettingsError(f"mounting clocking and offset must be finite, got {self.clocking_deg}, {self.offset}")

    def to_device(self, position: ArrayLike) -> NDArray[np.float64]:
        """Give what to send to the device for model positions (..., 2).

        Raises
        ------
        PoseError : a position is beyond the disk for the model, or for the device, which would clamp it unasked.
        """
        device = check_reach(position) @ self._matrix().T + np.array(self.offset)
        try:
            return check_reach(device)
        except PoseError as error:
            raise PoseError(f"as mounted (offset {self.offset}), the device's {error}") from error

    def to_model(self, device: ArrayLike) -> NDArray[np.float64]:
        """Give the model positions (..., 2) of what the device reports: the inverse of ``to_device``.

        Raises
        ------
        PoseError : a position is not finite or beyond the disk.
        """
        return check_reach((check_reach(device) - np.array(self.offset)) @ self._matrix())

    def _matrix(self) -> NDArray[np.float64]:
        """The orthogonal part, whose transpose undoes it."""
        turn = np.deg2rad(self.clocking_deg)
        matrix: NDArray[np.float64] = np.array(self.axes) @ [
            [np.cos(turn), -np.sin(turn)],
            [np.sin(turn), np.cos(turn)],
        ]
        return matrix
