"""What a stage is: a module in the folder, and all code that is reached from it; what leaves its digest alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.tasks.open_survey import STAGES
from storage.archive.keys import StageRef
from tests.flows.tasks.stage_closure import Sources

STAGE = """
import numpy as np
from models.light import Lamp, brighter as more
from pipeline import sums

LEAST = 3

def stage(lamp: Lamp, by: int = LEAST) -> int:
    from storage.store import write
    write(more(lamp, by))
    return sums.total(np.ones(by))

def unasked():
    return LEAST
"""
TEXTS = {
    "flows.tasks.stages": STAGE,
    "models.light": """
from pipeline.shapes import Shape

STEP = 2

class Lamp(Shape):
    size: int = STEP
    def lit(self): return self.size

def brighter(lamp, by):
    return lamp.lit() + by
""",
    "pipeline.shapes": "class Shape:\n    sides = 4\n",
    "pipeline.sums": "import math\n\ndef total(values):\n    return math.fsum(values)\n",
    "storage.store": "def write(value):\n    print(value)\n",
}


def digest(edits: dict[str, str], root: str = "stage") -> str:
    """Digest of the stage above with some modules in other words."""
    code = Sources(TEXTS | edits)
    return code.digest(code.closure([root]))


def edited(module: str, old: str, new: str) -> dict[str, str]:
    """One module with one thing changed."""
    assert old in TEXTS[module]
    return {module: TEXTS[module].replace(old, new)}


BESIDE = "from models.light import STEP\n\ndef stage(x):\n    return [STEP for STEP in x], STEP\n"
TABLE = "KNOWN = []\n\ndef register(one):\n    KNOWN.append(one)\n    return one\n"


@pytest.mark.parametrize("absent", [("average_raster", "take_patches"), ("rectify", "extract_patches")])
def test_every_stage_says_once_what_receipts_call_its_store(absent: tuple[str, str]) -> None:
    """No two stages of a survey, of a capture or of a raster, share a name in receipts; each has one at least."""
    ran = [one for name, one in STAGES.items() if name not in absent]
    named = [one.addresses(StageRef(one.product.name, "abc", Path())) for one in ran]
    assert all(named)
    assert len({name for one in named for name in one}) == sum(map(len, named))
