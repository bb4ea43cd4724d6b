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
REACHED = {
    ("flows.tasks.stages", "stage"),
    ("flows.tasks.stages", "LEAST"),
    ("models.light", "Lamp"),
    ("models.light", "brighter"),
    ("models.light", "STEP"),
    ("pipeline.shapes", "Shape"),
    ("pipeline.sums", "total"),
    ("storage.store", "write"),
}


def digest(edits: dict[str, str], root: str = "stage") -> str:
    """Digest of the stage above with some modules in other words."""
    code = Sources(TEXTS | edits)
    return code.digest(code.closure([root]))


def edited(module: str, old: str, new: str) -> dict[str, str]:
    """One module with one thing changed."""
    assert old in TEXTS[module]
    return {module: TEXTS[module].replace(old, new)}


def test_names_are_followed_through_imports_up_to_barriers() -> None:
    """Defaults, annotations, bases, modules' attributes lead on; what is behind a barrier alone is not reached."""
    assert Sources(TEXTS).closure(["stage"]) == REACHED
    behind = {("models.light", "Lamp"), ("models.light", "STEP"), ("pipeline.shapes", "Shape")}
    assert Sources(TEXTS).closure(["stage"], ["Lamp"]) == REACHED - behind


@pytest.mark.parametrize(
    "edit",
    [
        edited("flows.tasks.stages", "LEAST = 3", "LEAST = 4"),
        edited("flows.tasks.stages", "import numpy as np", "import cupy as np"),
        edited("models.light", "STEP = 2", "STEP = 1 + 2"),
        edited("models.light", "lamp.lit() + by", "lamp.lit() - by"),
        edited("pipeline.shapes", "sides = 4", "sides = 5"),
        edited("pipeline.sums", "fsum", "prod"),
        edited("storage.store", "print(value)", "print(value, value)"),
    ],
)
def test_an_edited_expression_changes_the_digest(edit: dict[str, str]) -> None:
    """Wherever in the closure it stands."""
    assert digest(edit) != digest({})


@pytest.mark.parametrize(
    "edit",
    [
        edited("models.light", "def brighter(lamp, by):", 'def brighter(lamp, by):\n    """Words."""'),
        edited("models.light", "    size: int = STEP", '    """Words."""\n\n    size: int = STEP  # px'),
        edited("pipeline.shapes", "class Shape:", '"""A module."""\nclass Shape:'),
        edited("storage.store", "print(value)", "print(\n        value,\n    )"),
        edited("flows.tasks.stages", "def unasked():\n    return LEAST", "def unasked():\n    return 0"),
        edited("flows.tasks.stages", "numpy as np", "numpy")
        | {"flows.tasks.stages": STAGE.replace("numpy as np", "numpy").replace("np.", "numpy.")},
        {"flows.tasks.stages": STAGE.replace("brighter as more", "brighter").replace("more(", "brighter(")},
        {
            "flows.tasks.stages": STAGE.replace("from pipeline import sums", "from pipeline.sums import total").replace(
                "sums.t", "t"
            )
        },
    ],
)
def test_other_words_for_the_same_leave_the_digest(edit: dict[str, str]) -> None:
    """Docstrings, comments, layout, how a name is imported, and code that the stage does not reach."""
    assert digest(edit) == digest({})


def test_a_moved_definition_leaves_the_digest() -> None:
    """A function, a class and a constant go to other files, and the imports with them."""
    lines = TEXTS["models.light"].splitlines(keepends=True)
    moved = {
        "flows.tasks.stages": STAGE.replace("models.light import", "models.beams import").replace(
            "pipeline import", "storage import"
        ),
        "models.light": "STEP = 2\n",
        "models.beams": "from models.light import STEP\n" + "".join(line for line in lines if "STEP = 2" not in line),
        "pipeline.sums": "",
        "storage.sums": TEXTS["pipeline.sums"],
    }
    assert digest(moved) == digest({})


LOCAL_NAMES = """
from models.light import Lamp, brighter, STEP

def stage(Lamp):
    for brighter in Lamp:
        print(brighter)
    return [STEP for STEP in Lamp] + [(lambda stage: stage)(1)]
"""
BESIDE = "from models.light import STEP\n\ndef stage(x):\n    return [STEP for STEP in x], STEP\n"
REGISTERED = """
from pipeline.table import KNOWN, register

def stage():
    return KNOWN

@register
def one(): return 1

KNOWN.append(2)
"""
CAST = """
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from models.light import Lamp

def stage(lamp):
    return cast("Lamp", lamp).lit()
"""
TABLE = "KNOWN = []\n\ndef register(one):\n    KNOWN.append(one)\n    return one\n"
STAGES_OWN = ("flows.tasks.stages", "stage")


@pytest.mark.parametrize(
    ("text", "reached"),
    [
        (BESIDE, {STAGES_OWN, ("models.light", "STEP")}),
        (LOCAL_NAMES, {STAGES_OWN}),
        (
            CAST,
            {
                STAGES_OWN,
                *(REACHED & {("models.light", name) for name in ("Lamp", "STEP")}),
                ("pipeline.shapes", "Shape"),
            },
        ),
        (
            REGISTERED,
            {
                *((STAGES_OWN[0], name) for name in ("stage", "one", "")),
                ("pipeline.table", "KNOWN"),
                ("pipeline.table", "register"),
            },
        ),
    ],
    ids=["a global beside a comprehension", "local names", "a type in a cast", "registrations"],
)
def test_what_names_lead_to(text: str, reached: set[tuple[str, str]]) -> None:
    """Local names hide definitions; what registers itself comes with its module; types for the checker count."""
    code = Sources(TEXTS | {"flows.tasks.stages": text, "pipeline.table": TABLE})
    assert code.closure(["stage"]) == reached


def test_a_name_must_say_which() -> None:
    """A root that no module has, or two have, is refused; the module's name tells two apart."""
    code = Sources({"flows.one": "def stage(): pass", "flows.two": "def stage(): pass"})
    assert code.named("two.stage") == ("flows.two", "stage")
    with pytest.raises(LookupError, match=r"one definition called stage, found it in \['flows.one', 'flows.two'\]"):
        code.named("stage")
    with pytest.raises(LookupError, match="called gone, found it in no module"):
        code.named("gone")


@pytest.mark.parametrize("absent", [("average_raster", "take_patches"), ("rectify", "cut_patches")])
def test_every_stage_says_once_what_receipts_call_its_store(absent: tuple[str, str]) -> None:
    """No two stages of a survey, of a capture or of a raster, share a name in receipts; each has one at least."""
    ran = [one for name, one in STAGES.items() if name not in absent]
    named = [one.addresses(StageRef(one.product.name, "abc", Path())) for one in ran]
    assert all(named)
    assert len({name for one in named for name in one}) == sum(map(len, named))
