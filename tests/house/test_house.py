"""The house's figures: trees in which something is wrong show it, and arrays are followed up the stack."""

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


def test_faults_of_a_tree_are_found() -> None:
    """A circle through a function, the import in it, and a name that two classes have."""
    (circle,) = source_tree.circles(TREES)
    assert set(circle.split(" -> ")) == {"pipeline.one", "pipeline.two"}
    assert source_tree.imported_in_functions(TREES) == {"pipeline/two.py": {"pipeline"}}
    assert source_tree.shared_class_names(TREES) == {"Line": 2}


def test_small_functions_and_settings_are_counted() -> None:
    """A function that is called once, one that is called twice, one with a decorator, one that is long."""
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
def test_pixels_are_arrays_as_large_as_a_line(value: object, pixels: bool) -> None:
    """By themselves, in a sequence, or as a field; vectors and small tables are none."""
    assert journey.has_pixels(value) == pixels


def test_files_on_the_stack_are_passed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who calls what takes pixels is passed, who only takes numbers is not, nor is what comes after the map."""
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
