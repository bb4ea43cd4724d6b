"""Gain from treating short exposures as fainter than they are: factors on the light's octaves.

Farms 51 to 53 gave the factor `FAINTER`; farms 0 and 41 to 43 check it.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from unittest import mock

from measure import Row
from rich.console import Console

from flows.settings.load import load_settings
from flows.survey_command import run_survey
from models.reading.inference import FAINTER

SEEDS = (51, 52, 53, 0, 41, 42, 43)
SECONDS = (8, 12, 16, 25)
FACTORS = (1.0, FAINTER, 1.8)


def scores(seed: int, seconds: float) -> list[float]:
    """Return the mIoU [%] of one scan for each factor, with every patch read in full."""
    found = []
    with tempfile.TemporaryDirectory() as out:
        asked = {"scene": "farm", "seed": seed, "seconds": seconds, "expected_loss": 0, "engine": "plain", "out": out}
        settings = load_settings(None, {name: str(one) for name, one in asked.items()} | {"controls": False})
        for factor in FACTORS:
            with mock.patch("models.reading.inference.FAINTER", factor):
                found.append(100 * float(run_survey(settings, Console(quiet=True)).receipt["accuracy"]["miou"]))
            for stage in ("segment", "evaluate"):  # their keys do not contain the factor
                shutil.rmtree(Path(out) / "stages" / stage)
    return found


def rows() -> list[Row]:
    """Return a row for each farm and time."""
    table = []
    for seconds in SECONDS:
        for seed in SEEDS:
            plain, told, more = scores(seed, seconds)
            peers = f"as it is {plain:.2f}; factor {FACTORS[2]:g} {more - plain:+.2f}"
            table.append(Row(f"farm {seed}, {seconds} s", f"{told - plain:+.2f}", "0 or more", told >= plain, peers))
            print(table[-1], flush=True)
    return table
