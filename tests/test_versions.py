"""A stage has a new version where code that determines its bytes has changed.

A changed digest asks for a decision. Raise the version of the stage if the same arguments now give other bytes, so that
archives make its stores anew. Then, or where the bytes are the same, record it: `python tests/test_versions.py`.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
from functools import cache
from pathlib import Path
from typing import Any

from spectralzoom.flows import survey
from spectralzoom.flows.stage import Stage

ROOT = Path(__file__).resolve().parents[1]
KNOWN = ROOT / "tests" / "versions.json"


@cache
def code_of(path: Path) -> str:
    """Return the code of a file without comments, docstrings and places."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.unparse(tree)


def record_of(stage: Stage[Any]) -> list[int | str]:
    """Return version and digest of a stage: of its own module, and of all code in the places that it names."""
    places = [ROOT / name for name in stage.made_by]
    files = {path for place in places for path in (place.rglob("*.py") if place.is_dir() else [place])}
    digest = hashlib.sha256(code_of(Path(inspect.getfile(stage.build))).encode())
    for path in sorted(files):
        digest.update(code_of(path).encode())
    return [stage.version, digest.hexdigest()[:16]]


def records() -> dict[str, list[int | str]]:
    """Return the records of all stages of a survey."""
    return {name: record_of(one) for name, one in sorted(vars(survey).items()) if isinstance(one, Stage)}


def test_changed_code_has_a_new_version() -> None:
    """The digests are those on record; the module's text says what to do."""
    assert records() == json.loads(KNOWN.read_text()), __doc__


if __name__ == "__main__":
    rows = (f"{json.dumps(name)}: {json.dumps(one)}" for name, one in records().items())
    KNOWN.write_text("{{\n {}\n}}\n".format(",\n ".join(rows)))
