"""How the mirror is mounted: the way to the device and back, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import PoseError, SettingsError
from pipeline.geometry.mirror import AXES, Mounting


@given(st.sampled_from(AXES), st.floats(-5, 5), st.floats(-0.05, 0.05), st.floats(0, 0.9), st.floats(0, 7))
def test_to_device_and_back_is_the_identity(axes: str, clocking: float, offset: float, radius: float, angle: float):
    """Any mounting is undone to rounding, anywhere that both disks hold."""
    mounting = Mounting(axes, clocking, offset, -offset)
    position = radius * np.array([np.cos(angle), np.sin(angle)])
    assert mounting.to_model(mounting.to_device(position)) == pytest.approx(position, abs=1e-15)


def test_axes_are_assigned_as_told():
    """X from Y and Y from -X, as in code seen in public; the default changes no bit, the sign of 0 included."""
    many = np.array([[0.3, 0.1], [-0.2, 0.5], [-0.0, 0.0]])
    swapped = np.array([[0.1, -0.3], [0.5, 0.2], [0.0, 0.0]])
    assert Mounting(axes="y,-x").to_device(many) == pytest.approx(swapped)
    assert Mounting().to_device(many).tobytes() == Mounting().to_model(many).tobytes() == many.tobytes()


def test_clocking_turns_from_x_to_y():
    """A quarter turn takes X to Y."""
    assert Mounting(clocking_deg=90).to_device([0.5, 0.0]) == pytest.approx([0, 0.5], abs=1e-15)


def test_what_the_device_would_clamp_is_refused():
    """An offset that pushes a position of the model beyond the device's rim raises with both numbers."""
    with pytest.raises(
        PoseError, match=r"as mounted \(offset 0.1; 0\).*1.05.*outside the unit disk.*less of the field"
    ):
        Mounting(offset_x=0.1).to_device([0.95, 0.0])


def test_mountings_that_are_none_are_refused():
    """Axes that are not both there, each once, and what is no number."""
    with pytest.raises(SettingsError, match=r"axes must be one of .*got 'x,x'"):
        Mounting(axes="x,x")
    with pytest.raises(SettingsError, match="must be finite"):
        Mounting(clocking_deg=float("nan"))
