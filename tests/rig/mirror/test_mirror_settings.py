"""Settings of the mirror driver refuse what means nothing."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.errors import SettingsError
from pipeline.rig.device_settings import MirrorSettings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("baud", 0),
        ("deadline_s", 1000),
        ("deadline_s", float("nan")),
        ("retries", -1),
        ("quiet_s", -1),
        ("vector_pairs", 0),
        ("vector_pairs", 8192),
        ("log_rate_hz", 20000),
        ("log_samples", True),
    ],
)
def test_numbers_out_of_range_are_refused(name: str, value: Any):
    """A number that nothing can mean (a deadline in ms) names the setting and the range."""
    with pytest.raises(SettingsError, match=f"mirror.{name} must be a number from .* to .* got"):
        MirrorSettings(**{name: value})


@pytest.mark.parametrize(("name", "value"), [("ends", "open"), ("read_back", "some")])
def test_unknown_choices_are_refused(name: str, value: Any):
    """A choice that there is not names those that there are."""
    with pytest.raises(SettingsError, match=f"mirror.{name} must be one of .*, got '{value}'"):
        MirrorSettings(**{name: value})


def test_defaults_are_assumed_and_say_so():
    """Nothing was confirmed on hardware."""
    settings = MirrorSettings()
    assert settings.provenance == "assumed"
    assert (settings.vector_pairs, settings.ends, settings.strict_crc) == (1500, "exclusive", False)
    assert settings.patience.deadline_s == settings.deadline_s
