"""The house's rules that imports can show: direction, one owner for each heavy package, nothing read at import."""

from __future__ import annotations

import ast
import importlib
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("pipeline", "models", "storage", "flows")
MAY_IMPORT = {
    "pipeline": {"pipeline"},
    "models": {"models", "pipeline"},
    "storage": {"storage", "pipeline"},
    "flows": {"flows", "models", "storage", "pipeline"},
}
OWNERS = {
    "prefect": ("flows",),
    "cyclopts": ("flows",),
    "rich": ("flows",),
    "matplotlib": ("flows",),
    "zarr": ("storage",),
    "xarray": ("storage",),
    "dask": ("storage", "flows"),
    "obstore": ("storage",),
    "serial": ("pipeline/rig",),
    "pyftpdlib": ("pipeline/rig",),
    "torch": ("models", "pipeline/rectify", "pipeline/simulator"),
}
DISTRIBUTIONS = {
    "PIL": "pillow",
    "serial": "pyserial",
    "skimage": "scikit-image",
    "odc": "odc-geo",
    "cv2": "opencv-contrib-python-headless",
}
FILE_MODULES = {"pathlib", "shutil", "tempfile", "glob", "io", "fileinput"}
READS = {"open", "read_text", "read_bytes", "getenv", "load_dotenv", "read_csv", "loadtxt", "load_file"}


def source_files() -> list[Path]:
    """Every source file of the four rooms, relative to the root."""
    return sorted(path.relative_to(ROOT) for room in ROOMS for path in (ROOT / room).rglob("*.py"))


def parse(path: Path) -> ast.Module:
    """The syntax tree of one file."""
    return ast.parse((ROOT / path).read_text(encoding="utf-8"), str(path))


def imported(tree: ast.AST) -> Iterator[str]:
    """Names of all modules imported anywhere in the file, those for type checkers included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")


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


@pytest.mark.parametrize("path", source_files(), ids=str)
def test_imports_go_one_way(path: Path):
    """flows -> models | storage -> pipeline; models and storage do not see each other; no import is relative."""
    for name in imported(parse(path)):
        root = name.split(".")[0]
        assert not name.startswith("."), f"{path} imports {name!r}; write the whole name"
        assert root not in ROOMS or root in MAY_IMPORT[path.parts[0]], f"{path} imports {name}"
        assert root != "tests", f"{path} imports {name}"


@pytest.mark.parametrize("path", source_files(), ids=str)
def test_heavy_packages_stay_with_their_owner(path: Path):
    """A heavy package is imported in its owner's folder alone."""
    for name in imported(parse(path)):
        homes = OWNERS.get(name.split(".")[0])
        assert homes is None or path.as_posix().startswith(tuple(f"{home}/" for home in homes)), (
            f"{path} imports {name}"
        )


@pytest.mark.parametrize("path", source_files(), ids=str)
def test_nothing_is_read_at_import(path: Path):
    """Importing a module reads no file, no environment and no settings."""
    for node in at_import(parse(path)):
        if isinstance(node, ast.Call):
            assert called_name(node) not in READS, f"{path}:{node.lineno} calls {called_name(node)} at import"
        assert not (isinstance(node, ast.Attribute) and node.attr == "environ"), f"{path}:{node.lineno} reads environ"


@pytest.mark.parametrize("path", [path for path in source_files() if path.parts[0] == "pipeline"], ids=str)
def test_pipeline_opens_no_files(path: Path):
    """Arrays (or a device's bytes) in, arrays out: no module of the pipeline but the rig's handles files."""
    if path.parts[1] == "rig":
        return
    tree = parse(path)
    assert not FILE_MODULES & {name.split(".")[0] for name in imported(tree)}
    calls = {called_name(node) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert not calls & {"open", "memmap", "getenv"}


def test_packages_are_those_of_this_folder():
    """An import takes the rooms of this project, not packages of the same name from elsewhere."""
    for room in ROOMS:
        module = importlib.import_module(room)
        assert module.__file__ is not None
        assert Path(module.__file__).resolve() == ROOT / room / "__init__.py"


def test_what_is_imported_is_declared():
    """Every package from outside that the source imports stands in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["geo"] + extras["s3"]
    declared = {re.split(r"[\[<>=~! ]", item, maxsplit=1)[0].lower() for item in wanted}
    outside = {name.split(".")[0] for path in source_files() for name in imported(parse(path))}
    outside -= {*ROOMS, *sys.stdlib_module_names}
    assert {DISTRIBUTIONS.get(name, name) for name in outside} <= declared


def test_walk_finds_what_it_looks_for():
    """The checks above see imports inside functions, reads in class bodies and defaults, and not in functions."""
    tree = ast.parse(
        "import os\nclass A:\n    x = os.getenv('A')\ndef f(y=open('b')):\n    import zarr\n    open('c')\n"
    )
    assert list(imported(tree)) == ["os", "zarr"]
    assert sorted(called_name(node) for node in at_import(tree) if isinstance(node, ast.Call)) == ["getenv", "open"]
