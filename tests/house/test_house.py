"""The figures of the source: faults of made-up trees are found, and arrays are followed up the stack."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.house import journey, source_tree

TREES = {
    Path("pipeline/one.py"): ast.parse("import pipeline.two\nclass Line: ..."),
    Path("pipeline/two.py"): ast.parse("def f():\n    from pipeline import one\nclass Line: ..."),
    Path("pipeline/three.py"): ast.parse("from pipeline.one import Line"),
}


def test_circles_inner_imports_and_shared_names_are_found() -> None:
    """The tree has a circle through an import in a function, and two classes of one name."""
    (circle,) = source_tree.circles(TREES)
    assert set(circle.split(" -> ")) == {"pipeline.one", "pipeline.two"}
    assert source_tree.imported_in_functions(TREES) == {"pipeline/two.py": {"pipeline"}}
    assert source_tree.shared_class_names(TREES) == {"Line": 2}


def test_inlinable_functions_settings_and_statements_are_counted() -> None:
    """Functions that are called twice, decorated or longer than the limit are not inlinable."""
    text = "def a(s: Settings): b()\ndef b(): c(); c()\ndef c(x: Settings | None): pass\n@d\ndef e(): pass\n"
    tree = {Path("pipeline/one.py"): ast.parse(text + "def f(): pass; pass\na(1); e(); f()")}
    assert source_tree.inlinable(tree, 1) == ["a"]
    assert sorted(source_tree.inlinable(tree, 2)) == ["a", "b", "f"]
    assert source_tree.parameters_of_type(tree, "Settings") == 2
    assert source_tree.statements(tree) == 15


@pytest.mark.parametrize(
    ("value", "pixels"),
    [
        (np.zeros((640, 3)), True),
        (np.zeros((32, 10)), False),
        (np.zeros(10_000), False),
        ("a", False),
        ([None, np.zeros((20, 32))], True),
        (SimpleNamespace(values=np.zeros((1, 640))), True),
        (SimpleNamespace(held=SimpleNamespace(values=np.zeros((1, 640)))), False),
    ],
)
def test_arrays_as_large_as_a_line_are_pixels(value: object, pixels: bool) -> None:
    """They count as a value, in a sequence, or as a field; vectors and small tables do not count."""
    assert journey.has_pixels(value) == pixels


def test_files_on_the_stack_are_collected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller of a function that takes pixels counts; functions of numbers, and calls after the map, do not."""
    sources = {
        "command": "def run(lines, build, count):\n    count(3)\n    build(lines)\n    count(lines)",
        "maps": "def build(lines):\n    return lines",
        "counts": "def count(number):\n    return number",
    }
    monkeypatch.setattr(journey, "ROOT", tmp_path)
    monkeypatch.setattr(journey, "MAP_DRAWN", ("pipeline/maps.py", "build"))
    journey.file_of.cache_clear()
    modules = {}
    for name, text in sources.items():
        path = tmp_path / "pipeline" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(f"followed_{name}", path)
        assert spec is not None
        assert spec.loader is not None
        modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    before = sys.getprofile()
    with journey.passed_files() as passed:
        modules["command"].run(np.zeros((1, 640)), modules["maps"].build, modules["counts"].count)
    sys.setprofile(before)
    assert passed == {"pipeline/command.py", "pipeline/maps.py"}
    journey.file_of.cache_clear()
