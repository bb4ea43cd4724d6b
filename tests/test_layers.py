"""Rules of the source tree that imports show: direction, one owner of each heavy package, no circle, small folders."""

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
MOST_LINES = 8  # of a definition that is clear without a docstring
IN_FUNCTIONS = {  # file -> packages that a function of it imports, and the reason
    "flows/publish/publishing.py": ("PIL", "for Prefect's pages alone"),
    "storage/remote/object_stores.py": ("obstore", "an extra: that it is missing is told"),
}


@pytest.fixture(scope="module", autouse=True)
def _trees_are_no_garbage() -> Iterator[None]:
    """Exclude the syntax trees (half a million nodes) from garbage collection, and drop them after these tests."""
    gc.disable()
    yield
    source.cache_clear()
    nodes.cache_clear()
    gc.enable()


def at_import(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes that run when the module is imported: all but the bodies of functions."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += [*node.decorator_list, *node.args.defaults, *(item for item in node.args.kw_defaults if item)]
        elif not isinstance(node, ast.Lambda):
            waiting += ast.iter_child_nodes(node)


def called_name(node: ast.Call) -> str:
    """Return the last part of a called name."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def test_imports_go_one_way() -> None:
    """The order is spectralzoom -> flows -> models | storage -> pipeline; no import is relative."""
    wrong = [
        f"{path} imports {name}"
        for path, tree in source().items()
        for name in imported(tree)
        if name.startswith((".", "tests"))
        or (name.split(".")[0] in ROOMS and name.split(".")[0] not in MAY_IMPORT[path.parts[0]])
    ]
    assert wrong == []


def test_storage_imports_only_listed_modules_of_rectify_and_signal() -> None:
    """Storage rectifies nothing, and calibrates only scene files with dark and white frames: it imports these names."""
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


def test_rectify_imports_no_calibration() -> None:
    """Rectification and registration get lines that `pipeline.signal.lines` has read and calibrated, no raw numbers."""
    trees = [tree for path, tree in source().items() if path.parts[:2] == ("pipeline", "rectify")]
    assert not [name for tree in trees for name in imported(tree) if name.startswith("pipeline.signal.calibrate")]


def test_heavy_packages_stay_with_their_owner() -> None:
    """A heavy package is imported only in its owner's folder; `pipeline.lazy` only defers its loading."""
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
    """Modules read no file, environment variable or setting outside of functions."""
    wrong = [
        f"{path}:{node.lineno}"
        for path, tree in source().items()
        for node in at_import(tree)
        if (isinstance(node, ast.Call) and called_name(node) in READS)
        or (isinstance(node, ast.Attribute) and node.attr == "environ")
    ]
    assert wrong == []


def test_pipeline_opens_no_files() -> None:
    """Arrays or a device's bytes come in, arrays go out; only the rig and large simulated scenes need files."""
    known = {path: tree for path, tree in source().items() if path.parts[0] == "pipeline" and path.parts[1] != "rig"}
    numeric = {path: tree for path, tree in known.items() if path.name != "scratch.py"}
    assert [path for path, tree in numeric.items() if FILE_MODULES & {n.split(".")[0] for n in imported(tree)}] == []
    opening = {"open", "memmap", "getenv"}
    calls = ((path, node) for path, tree in numeric.items() for node in nodes(tree) if isinstance(node, ast.Call))
    assert [f"{path}:{node.lineno}" for path, node in calls if called_name(node) in opening] == []


def test_imports_form_no_circle() -> None:
    """Imports within functions and for type checkers count too."""
    assert circles(source()) == []


def test_rooms_import_one_way() -> None:
    """A room is a folder of a package, or a module beside its folders; two rooms do not import each other."""
    known = {module_name(path) for path in source()}
    pairs = {
        (".".join(path.with_suffix("").parts[:2]), ".".join(name.split(".")[:2]))
        for path, tree in source().items()
        for name in imported_files(path, tree, known)
    }
    mutual = {(one, other) for one, other in pairs if one < other and (other, one) in pairs}
    assert mutual == {("storage.archive", "storage.arrays")}  # a finished store is consolidated; arrays have keys


def test_every_file_has_a_user() -> None:
    """Another file imports it or names it for lazy loading; the only exception is the module of the script."""
    known = {module_name(path) for path in source() if path.name != "__init__.py"}
    used = set[str]().union(*(imported_files(path, tree, known) for path, tree in source().items()))
    named = {node.value for tree in source().values() for node in nodes(tree) if isinstance(node, ast.Constant)}
    assert known - used - named == {"flows.cli.main"}  # the module of the script


def test_imports_are_at_the_top_of_files() -> None:
    """Slow packages are deferred there; a function imports only the packages that the table lists with a reason."""
    assert imported_in_functions(source()) == {path: set(names.split()) for path, (names, _) in IN_FUNCTIONS.items()}


def test_no_folder_has_too_many_files() -> None:
    """The limit for source and tests is the number of files that a person can keep in mind."""
    count = files_by_folder([*source(), *files_of_tests()])
    assert {folder: files for folder, files in count.items() if files > MOST_FILES} == {}


def test_class_names_are_unique() -> None:
    """A class name identifies one class of the source."""
    assert shared_class_names(source()) == {}


def test_long_public_definitions_have_a_docstring() -> None:
    """The rule holds for public functions, methods and classes of more than 8 lines."""
    silent = [
        f"{path}:{node.lineno} {node.name}"
        for path, tree in source().items()
        for node in public(tree)
        if (node.end_lineno or node.lineno) - node.lineno >= MOST_LINES and not ast.get_docstring(node)
    ]
    assert silent == []


def test_packages_are_imported_from_this_checkout() -> None:
    """Packages of the same name from elsewhere must not be tested."""
    for room in ROOMS:
        module = importlib.import_module(room)
        assert Path(str(module.__file__)).resolve() == ROOT / room / "__init__.py"


def test_imported_packages_are_declared() -> None:
    """pyproject.toml lists every third-party package that the source imports, with those of the extra s3."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["s3"]
    declared = {re.split(r"[\[<>=~! ]", item, maxsplit=1)[0].lower() for item in wanted}
    outside = {name.split(".")[0] for tree in source().values() for name in imported(tree)}
    assert {DISTRIBUTIONS.get(name, name) for name in outside - {*ROOMS, *sys.stdlib_module_names}} <= declared


def test_nested_imports_and_reads_at_import_are_found() -> None:
    """The checks see imports in functions, and reads in class bodies and defaults, but not reads in functions."""
    tree = ast.parse("import os\nclass A:\n x = os.getenv('A')\ndef f(y=open('b')):\n import zarr\n open('c')\n")
    assert list(imported(tree)) == ["os", "zarr"]
    assert sorted(called_name(node) for node in at_import(tree) if isinstance(node, ast.Call)) == ["getenv", "open"]


def test_public_definitions_are_found() -> None:
    """Methods and nested functions count, but no definition whose own name begins with an underscore."""
    tree = ast.parse("class A:\n    def b(self): ...\n    def _c(self):\n        def d(): ...\n")
    assert [node.name for node in public(tree)] == ["A", "b", "d"]
