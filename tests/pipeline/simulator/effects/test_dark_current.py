"""Dark current and temperature: silicon's law, by hand and against measurements, and the range that it is held to."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.simulator.effects.counting import BOLTZMANN_EV_PER_K, band_gap_ev, dark_electrons, warmth
from pipeline.simulator.rig_model import Detector, Rig

DEGREES = st.floats(-80.0, 49.0)


def doubling_deg(temperature_deg_c: float) -> float:
    """How many degrees about a temperature make twice the dark current."""
    return 0.2 * math.log(2) / math.log(warmth(temperature_deg_c + 0.1) / warmth(temperature_deg_c - 0.1))


@pytest.mark.parametrize(("kelvin", "ev"), [(0.0, 1.1557), (300.0, 1.1108), (193.15, 1.1356)])
def test_band_gap_by_hand(kelvin: float, ev: float) -> None:
    """1.1557 - 7.021e-4 T^2 / (1108 + T): 1.11 eV in a warm room."""
    assert band_gap_ev(kelvin) == pytest.approx(ev, abs=1e-4)


def test_absolute_size_by_janesick() -> None:
    """His 2.5e15 T^1.5 exp(-Eg / 2kT) e-/s from 1 cm^2 of 1 nA/cm^2 at 300 K gives that nA back, 6.24e9 e-/s."""
    rate = 2.5e15 * 300**1.5 * math.exp(-band_gap_ev(300) / (2 * BOLTZMANN_EV_PER_K * 300))
    assert rate == pytest.approx(6.24e9, rel=0.03)


@pytest.mark.parametrize(
    ("deg_c", "factor"), [(25.0, 1.0), (0.0, 0.1056), (-40.0, 1.12e-3), (-80.0, 1.97e-6), (50.0, 6.80)]
)
def test_warmth_by_hand(deg_c: float, factor: float) -> None:
    """Worked with a pocket calculator: at -80 deg C (193.15 / 298.15)^1.5 exp(21.629 - 34.114) = 1.97e-6."""
    assert warmth(deg_c) == pytest.approx(factor, rel=3e-3)


@pytest.mark.parametrize(("deg_c", "doubles"), [(25.0, 8.4), (-80.0, 3.6)])
def test_it_doubles_in_fewer_degrees_in_the_cold(deg_c: float, doubles: float) -> None:
    """Not every 7 deg C, as a rule of thumb has it: ln 2 over 1.5 / T + (Eg - T Eg') / 2kT^2."""
    assert doubling_deg(deg_c) == pytest.approx(doubles, abs=0.05)


@given(DEGREES, st.floats(0.1, 1.0))
def test_warmer_is_more_and_ever_less_so(deg_c: float, way: float) -> None:
    """It rises everywhere, by a factor that shrinks as it gets warmer."""
    assert warmth(deg_c + way) > warmth(deg_c)
    assert warmth(deg_c + way) / warmth(deg_c) <= warmth(deg_c - 1 + way) / warmth(deg_c - 1)


def test_the_stated_rate_is_that_of_25_deg_c() -> None:
    """200 e-/s there: 20 e- in 100 ms, exactly; at 33.4 deg C twice as many."""
    assert dark_electrons(Rig()) == 20.0
    assert dark_electrons(Rig(detector=Detector(temperature_deg_c=33.4))) == pytest.approx(40, rel=0.02)


@pytest.mark.parametrize("deg_c", [-80.5, 51.0])
def test_beyond_the_laws_range_is_refused(deg_c: float) -> None:
    """Below, other leaks lead; above, what diffuses from the bulk."""
    with pytest.raises(SettingsError, match=r"detector\.temperature_deg_c must be a number from -80 to 50 deg C"):
        Rig(detector=Detector(temperature_deg_c=deg_c))
