"""Imports go one way, each heavy package is imported in the folders that own it, and packages are declared."""

from __future__ import annotations

import ast
import importlib
import re
import sys
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "spectralzoom"
MAY_IMPORT = {
    "pipeline": {"pipeline"},
    "models": {"models", "pipeline"},
    "storage": {"storage", "pipeline"},
    "flows": {"flows", "models", "storage", "pipeline"},
    "src": {"src", "flows", "models", "storage", "pipeline"},
}
MOST_OF_A_STAGE = 70  # modules, with packages
MOST_OF_THE_FLOW = 0.62  # of the modules
NOT_OURS = {"", "tests", *MAY_IMPORT}  # relative, of tests, or of the user's own folders
OWNERS = {
    **dict.fromkeys(("prefect", "cyclopts", "matplotlib"), ("flows/",)),
    **dict.fromkeys(("zarr", "obstore"), ("storage/",)),
    **{"serial": ("pipeline/rig/",), "numba": ("pipeline/",), "torch": ("models/", "pipeline/rectify/")},
    **{"dask": ("storage/", "flows/"), "xarray": ("storage/", "src/"), "rich": ("flows/", "src/")},
}
DISTRIBUTIONS = {
    **{"PIL": "pillow", "sklearn": "scikit-learn", "serial": "pyserial", "skimage": "scikit-image"},
    **{"odc": "odc-geo", "rio_stac": "rio-stac", "mpl_toolkits": "matplotlib"},
}


def imports() -> list[tuple[str, str]]:
    """Return each file of the source with each module that it imports, also in functions and for type checkers."""
    found = []
    for path in (path for room in MAY_IMPORT for path in sorted((ROOT / room).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += ["." * node.level + (node.module or "")] if isinstance(node, ast.ImportFrom) else []
            found += [(path.relative_to(ROOT).as_posix(), name) for name in names]
    return found


def room_of(name: str) -> str:
    """Return the folder of a module of the product by its import name."""
    return next((part for part in name.split(".")[1:2] if part in MAY_IMPORT), "src")


def test_settings_read_no_archive_and_no_file_of_a_scene() -> None:
    """They import nothing of `storage`: what an archive knows is a layer of defaults that its caller gives."""
    assert [one for one in imports() if one[0].startswith("flows/settings/") and room_of(one[1]) == "storage"] == []


@cache
def loads(module: str) -> frozenset[str]:
    """Return the modules of the product that a module's own code loads, without those in functions or for types."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    body = ast.parse(file.read_text(encoding="utf-8")).body if file.is_file() else []
    froms = [(node.module or "", one.name) for node in body if isinstance(node, ast.ImportFrom) for one in node.names]
    names = [name for module, one in froms for name in (module, f"{module}.{one}")]
    names += [one.name for node in body if isinstance(node, ast.Import) for one in node.names]
    return frozenset(name for name in names if name.startswith("spectralzoom.") and is_module(name))


def is_module(name: str) -> bool:
    """Return whether a name is that of a module or package of the product."""
    path = PACKAGE.joinpath(*name.split(".")[1:])
    return path.is_dir() or path.with_suffix(".py").is_file()


def closure(module: str) -> set[str]:
    """Return all modules that a module loads, and their packages."""
    found: set[str] = set()
    left = [module]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left += [*loads(name), *([name.rpartition(".")[0]] if "." in name else [])]
    return found


def test_a_stage_and_the_flow_load_a_part_of_the_product() -> None:
    """A stage loads what it needs alone, and the order of stages is apart from what opens files."""
    stages = [f"spectralzoom.flows.stages.{path.stem}" for path in (ROOT / "flows" / "stages").glob("[a-z]*.py")]
    many = {name: len(closure(name)) for name in stages if len(closure(name)) > MOST_OF_A_STAGE}
    assert (len(stages) > 10, many) == (True, {})
    files = sum(1 for room in MAY_IMPORT if room != "src" for _ in (ROOT / room).rglob("*.py"))
    assert 100 < len(closure("spectralzoom.flows.survey")) <= MOST_OF_THE_FLOW * files


def test_imports_go_one_way_and_packages_are_declared() -> None:
    """The order is src, flows, models and storage, pipeline; no import is relative or of tests."""
    found = [(file, name, name.split(".")[0]) for file, name in imports()]
    assert [one for one in found if one[2] in NOT_OURS] == []
    ours = [(file, room_of(name)) for file, name, top in found if top == "spectralzoom"]
    assert [one for one in ours if one[1] not in MAY_IMPORT[one[0].split("/")[0]]] == []
    assert [one for one in found if not one[0].startswith(OWNERS.get(one[2], ""))] == []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["s3"]
    declared = {re.split(r"[\[<>=~! ]", item, maxsplit=1)[0].lower() for item in wanted}
    outside = {top for *_, top in found} - {"spectralzoom", *sys.stdlib_module_names}
    assert {DISTRIBUTIONS.get(name, name) for name in outside} <= declared
    for room in MAY_IMPORT:  # packages of the same name from elsewhere are not tested
        name, folder = ("spectralzoom", PACKAGE) if room == "src" else (f"spectralzoom.{room}", ROOT / room)
        assert Path(str(importlib.import_module(name).__file__)).resolve() == folder / "__init__.py"
