"""The house's rules that imports can show: direction, one owner for each heavy package, no circle, small rooms."""

from __future__ import annotations

import ast
import gc
import importlib
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.house.source_tree import (
    LAZY,
    ROOMS,
    ROOT,
    circles,
    files_by_folder,
    files_of_tests,
    imported,
    imported_files,
    imported_in_functions,
    module_name,
    nodes,
    public,
    shared_class_names,
    source,
)

MAY_IMPORT = {
    "pipeline": {"pipeline"},
    "models": {"models", "pipeline"},
    "storage": {"storage", "pipeline"},
    "flows": {"flows", "models", "storage", "pipeline"},
    "spectralzoom": {"spectralzoom", "flows", "models", "storage", "pipeline"},
}
OWNERS = {
    **dict.fromkeys(("prefect", "cyclopts", "matplotlib"), ("flows",)),
    **dict.fromkeys(("zarr", "obstore"), ("storage",)),
    **dict.fromkeys(("serial", "pyftpdlib"), ("pipeline/rig",)),
    **{"rich": ("flows", "spectralzoom"), "xarray": ("storage", "spectralzoom"), "dask": ("storage", "flows")},
    **{"torch": ("models", "pipeline/rectify"), "numba": ("pipeline",)},
}
DISTRIBUTIONS = {
    **{"PIL": "pillow", "sklearn": "scikit-learn", "serial": "pyserial", "skimage": "scikit-image"},
    **{"odc": "odc-geo", "mpl_toolkits": "matplotlib"},
}
FILE_MODULES = {"pathlib", "shutil", "tempfile", "glob", "io", "fileinput"}
READS = {"open", "read_text", "read_bytes", "getenv", "load_dotenv", "read_csv", "loadtxt", "load_file"}
MOST_FILES = 25  # in a folder
MOST_LINES = 8  # of what is clear without a docstring
IN_FUNCTIONS = {  # file -> packages that a function of it imports, and why no file's head does
    "flows/publish/publishing.py": ("PIL", "for Prefect's pages alone"),
    "storage/remote/object_stores.py": ("obstore", "an extra: that it is missing is told"),
}


@pytest.fixture(scope="module", autouse=True)
def _trees_are_no_garbage() -> Iterator[None]:
    """They are half a million nodes: no search looks through them, neither now nor, for they go, in the tests after."""
    gc.disable()
    yield
    source.cache_clear()
    nodes.cache_clear()
    gc.enable()


def at_import(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes that run when the module is imported: all but the bodies of functions."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += [*node.decorator_list, *node.args.defaults, *(item for item in node.args.kw_defaults if item)]
        elif not isinstance(node, ast.Lambda):
            waiting += ast.iter_child_nodes(node)


def called_name(node: ast.Call) -> str:
    """The last part of what is called."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def test_imports_go_one_way() -> None:
    """spectralzoom -> flows -> models | storage -> pipeline, models and storage apart; no import is relative."""
    wrong = [
        f"{path} imports {name}"
        for path, tree in source().items()
        for name in imported(tree)
        if name.startswith((".", "tests"))
        or (name.split(".")[0] in ROOMS and name.split(".")[0] not in MAY_IMPORT[path.parts[0]])
    ]
    assert wrong == []


def test_storage_stores() -> None:
    """It rectifies and calibrates nothing: of `rectify` it knows what it writes down, of `signal` what files need."""
    known = {
        "storage/arrays/geolocation.py": {"pipeline.rectify.placed", "pipeline.rectify.scan_paths"},
        "storage/arrays/layout.py": {f"pipeline.signal.{one}" for one in ("components", "condense")},
        "storage/arrays/mosaics.py": {"pipeline.signal.components"},
        "storage/arrays/signal_cubes.py": {f"pipeline.signal.{one}" for one in ("calibrate", "components", "condense")},
        "storage/arrays/cubes.py": {"pipeline.signal.subspace"},
        "storage/readers/cube_sources.py": {"pipeline.signal.calibrate"},
        "storage/readers/recorded_files.py": {"pipeline.signal.calibrate"},
    }
    found = {
        path.as_posix(): names
        for path, tree in source().items()
        if path.parts[0] == "storage"
        and (names := {name for name in imported(tree) if name.startswith(("pipeline.rectify", "pipeline.signal"))})
    }
    assert found == known


def test_a_survey_calibrates_in_one_place() -> None:
    """What is rectified and registered is never a raw number: `pipeline.signal.lines` has read and calibrated it."""
    trees = [tree for path, tree in source().items() if path.parts[:2] == ("pipeline", "rectify")]
    assert not [name for tree in trees for name in imported(tree) if name.startswith("pipeline.signal.calibrate")]


def test_heavy_packages_stay_with_their_owner() -> None:
    """A heavy package is imported in its owner's folder alone; `pipeline.lazy` only says that it loads late."""
    wrong = [
        f"{path} imports {name}"
        for path, tree in source().items()
        for name in imported(tree)
        if name.split(".")[0] in OWNERS
        and path.as_posix() != LAZY
        and not path.as_posix().startswith(tuple(f"{home}/" for home in OWNERS[name.split(".")[0]]))
    ]
    assert wrong == []


def test_nothing_is_read_at_import() -> None:
    """Importing a module reads no file, no environment and no settings."""
    wrong = [
        f"{path}:{node.lineno}"
        for path, tree in source().items()
        for node in at_import(tree)
        if (isinstance(node, ast.Call) and called_name(node) in READS)
        or (isinstance(node, ast.Attribute) and node.attr == "environ")
    ]
    assert wrong == []


def test_pipeline_opens_no_files() -> None:
    """Arrays (or a device's bytes) in, arrays out: only the rig and arrays of large simulated scenes need files."""
    known = {path: tree for path, tree in source().items() if path.parts[0] == "pipeline" and path.parts[1] != "rig"}
    numeric = {path: tree for path, tree in known.items() if path.name != "scratch.py"}
    assert [path for path, tree in numeric.items() if FILE_MODULES & {n.split(".")[0] for n in imported(tree)}] == []
    opening = {"open", "memmap", "getenv"}
    calls = ((path, node) for path, tree in numeric.items() for node in nodes(tree) if isinstance(node, ast.Call))
    assert [f"{path}:{node.lineno}" for path, node in calls if called_name(node) in opening] == []


def test_no_file_imports_itself_in_a_circle() -> None:
    """Every file stands above all that it imports, within functions and for type checkers too."""
    assert circles(source()) == []


def test_every_file_has_a_user() -> None:
    """Another file imports it, or names it as what is loaded when it is asked for; but what others begin with."""
    known = {module_name(path) for path in source() if path.name != "__init__.py"}
    used = set[str]().union(*(imported_files(path, tree, known) for path, tree in source().items()))
    named = {node.value for tree in source().values() for node in nodes(tree) if isinstance(node, ast.Constant)}
    assert known - used - named == {"flows.cli.main"}  # of the script


def test_files_say_at_their_heads_what_they_need() -> None:
    """What takes long to load is deferred at a file's head; functions import only what the table gives a reason for."""
    known = {path: set(packages.split()) for path, (packages, _) in IN_FUNCTIONS.items()}
    assert imported_in_functions(source()) == known


def test_folders_can_be_held_in_mind() -> None:
    """No folder of the house or of its tests has more files than a person can hold in mind."""
    count = files_by_folder([*source(), *files_of_tests()])
    assert {folder: files for folder, files in count.items() if files > MOST_FILES} == {}


def test_class_names_are_unique() -> None:
    """Whoever reads the name of a class knows which one is meant."""
    assert shared_class_names(source()) == {}


def test_what_is_public_says_what_it_does() -> None:
    """A public function, method or class of more lines than are read at a glance has a docstring."""
    silent = [
        f"{path}:{node.lineno} {node.name}"
        for path, tree in source().items()
        for node in public(tree)
        if (node.end_lineno or node.lineno) - node.lineno >= MOST_LINES and not ast.get_docstring(node)
    ]
    assert silent == []


def test_packages_are_those_of_this_folder() -> None:
    """An import takes the rooms of this project, not packages of the same name from elsewhere."""
    for room in ROOMS:
        module = importlib.import_module(room)
        assert module.__file__ is not None
        assert Path(module.__file__).resolve() == ROOT / room / "__init__.py"


def test_what_is_imported_is_declared() -> None:
    """Every package from outside that the source imports stands in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["s3"]
    declared = {re.split(r"[\[<>=~! ]", item, maxsplit=1)[0].lower() for item in wanted}
    outside = {name.split(".")[0] for tree in source().values() for name in imported(tree)}
    outside -= {*ROOMS, *sys.stdlib_module_names}
    assert {DISTRIBUTIONS.get(name, name) for name in outside} <= declared


def test_walk_finds_what_it_looks_for() -> None:
    """The checks above see imports inside functions, reads in class bodies and defaults, and not in functions."""
    tree = ast.parse("import os\nclass A:\n x = os.getenv('A')\ndef f(y=open('b')):\n import zarr\n open('c')\n")
    assert list(imported(tree)) == ["os", "zarr"]
    assert sorted(called_name(node) for node in at_import(tree) if isinstance(node, ast.Call)) == ["getenv", "open"]


def test_walk_finds_what_is_public() -> None:
    """Methods are seen, and functions in functions, but nothing whose own name begins with an underscore."""
    tree = ast.parse("class A:\n    def b(self): ...\n    def _c(self):\n        def d(): ...\n")
    assert [node.name for node in public(tree)] == ["A", "b", "d"]
