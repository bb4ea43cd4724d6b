"""How the mirror is mounted: calibration data between the XY that a device takes and the XY of the model.

The paper leaves out which axis of the device is which and which way it turns (erratum E6). The default is the model's
own axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, SettingsError
from pipeline.geometry.mirror import check_reach

Axes = Literal["x,y", "x,-y", "-x,y", "-x,-y", "y,x", "y,-x", "-y,x", "-y,-x"]
AXES: tuple[Axes, ...] = get_args(Axes)
_ROWS = {"x": (1, 0), "-x": (-1, 0), "y": (0, 1), "-y": (0, -1)}


@dataclass(frozen=True)
class Mounting:
    """Device XY = axes @ rotation(clocking_deg) @ model XY + offset.

    ``axes`` says what the device's X and Y are: "y,-x" that its X is the model's Y and its Y the model's -X.
    ``clocking_deg`` is the small turn of the mirror about its rest normal, anticlockwise from X to Y, and the offset
    the device's XY at the model's rest.
    """

    axes: str = "x,y"
    clocking_deg: float = 0.0
    offset_x: float = 0.0
    offset_y: float = 0.0

    def __post_init__(self) -> None:
        if self.axes not in AXES:
            raise SettingsError(f"a mirror's axes must be one of {'  '.join(AXES)}; got {self.axes!r}")
        if not np.isfinite([self.clocking_deg, self.offset_x, self.offset_y]).all():
            raise SettingsError(f"a mirror's clocking and offset must be finite, got {self}")

    def to_device(self, position: ArrayLike) -> NDArray[np.floating]:
        """Give what to send to the device for model positions (..., 2).

        Raises
        ------
        PoseError : a position is beyond the disk for the model, or for the device, which would clamp it unasked.
        """
        model = check_reach(position)
        if self == STRAIGHT:
            return model
        device = model @ self._matrix().T + (self.offset_x, self.offset_y)
        try:
            return check_reach(device)
        except PoseError as error:
            raise PoseError(
                f"as mounted (offset {self.offset_x:g}; {self.offset_y:g}), the device's {error}; survey less of the "
                "field, or mount the mirror nearer to its middle"
            ) from error

    def to_model(self, device: ArrayLike) -> NDArray[np.float64]:
        """Give the model positions (..., 2) of what the device reports: the inverse of ``to_device``.

        What was measured may lie a little beyond the rim, and is not refused.
        """
        given = np.asarray(device, np.float64)
        model: NDArray[np.float64] = (given - (self.offset_x, self.offset_y)) @ self._matrix()
        return given if self == STRAIGHT else model

    def _matrix(self) -> NDArray[np.float64]:
        """The orthogonal part, whose transpose undoes it."""
        turn = np.deg2rad(self.clocking_deg)
        rotation = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        matrix: NDArray[np.float64] = np.array([_ROWS[axis] for axis in self.axes.split(",")]) @ rotation
        return matrix


STRAIGHT = Mounting()
