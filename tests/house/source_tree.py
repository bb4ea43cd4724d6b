"""The source files as syntax trees, and their figures: lines, imports, circles, names."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LAZY = "pipeline/lazy.py"
ROOMS = ("pipeline", "models", "storage", "flows", "spectralzoom")
Trees = Mapping[Path, ast.Module]
Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


@cache
def source() -> dict[Path, ast.Module]:
    """Return the syntax tree of every source file, by its path from the root."""
    found = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    return {path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8"), str(path)) for path in found}


def files_of_tests() -> list[Path]:
    """Return every file of the tests, by its path from the root."""
    return sorted(path.relative_to(ROOT) for path in (ROOT / "tests").rglob("*.py"))


@cache
def nodes(tree: ast.AST) -> list[ast.AST]:
    """Return all nodes of a tree, walked once for all rules."""
    return list(ast.walk(tree))


@cache
def late_packages() -> dict[str, str]:
    """Return the packages that `pipeline.lazy` defers, and those of its types, by their names there."""
    tree = ast.parse((ROOT / LAZY).read_text(encoding="utf-8"))
    inner = [node for block in tree.body if isinstance(block, ast.If) for node in block.body]
    types = {one.name: node.module or "" for node in inner if isinstance(node, ast.ImportFrom) for one in node.names}
    found = [alias for node in inner if isinstance(node, ast.Import) for alias in node.names]
    return types | {alias.asname or alias.name: alias.name for alias in found}


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield the names of all modules that a file imports, also for type checkers or deferred."""
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")
            if node.module == "pipeline.lazy":
                yield from (late_packages()[alias.name] for alias in node.names if alias.name in late_packages())


def imported_in_functions(trees: Trees) -> dict[str, set[str]]:
    """Return the packages that functions import, by file."""
    found: dict[str, set[str]] = {}
    for path, tree in trees.items():
        inner = [node for node in nodes(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
        if names := {name.split(".")[0] for function in inner for name in imported(function)}:
            found[path.as_posix()] = names
    return found


def module_name(path: Path) -> str:
    """Return the name by which a file is imported."""
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def imported_files(path: Path, tree: ast.Module, known: set[str]) -> set[str]:
    """Return the modules of the source that a file imports, also by ``from package import module``."""
    names = set(imported(tree))
    for node in nodes(tree):
        if isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return (names & known) - {module_name(path)}


def circles(trees: Trees) -> list[str]:
    """Return the circles of files that import each other, also within functions and for type checkers."""
    known = {module_name(path) for path in trees if path.name != "__init__.py"}
    graph = {module_name(path): imported_files(path, tree, known) for path, tree in trees.items()}
    found = []
    while True:
        try:
            TopologicalSorter(graph).prepare()
            return found
        except CycleError as error:
            circle = error.args[1]
            found.append(" -> ".join(reversed(circle)))
            graph[circle[1]].discard(circle[0])


def files_by_folder(paths: Iterable[Path]) -> Counter[str]:
    """Return the number of files in every folder."""
    return Counter(path.parent.as_posix() for path in paths)


def shared_class_names(trees: Trees) -> dict[str, int]:
    """Return the class names that are used more than once, with their counts."""
    names = Counter(node.name for tree in trees.values() for node in nodes(tree) if isinstance(node, ast.ClassDef))
    return {name: count for name, count in names.items() if count > 1}


def statements(trees: Trees) -> int:
    """Return the number of statements in the files."""
    return sum(isinstance(node, ast.stmt) for tree in trees.values() for node in nodes(tree))


def functions(trees: Trees) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield every function and method."""
    for tree in trees.values():
        yield from (node for node in nodes(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def inlinable(trees: Trees, most: int) -> list[str]:
    """Return the names of undecorated functions of at most ``most`` statements that are named in one place."""
    named = Counter[str]()
    for tree in trees.values():
        named.update(node.id for node in nodes(tree) if isinstance(node, ast.Name))
        named.update(node.attr for node in nodes(tree) if isinstance(node, ast.Attribute))
    return [
        one.name
        for one in functions(trees)
        if named[one.name] == 1
        and not one.decorator_list
        and sum(isinstance(x, ast.stmt) for x in nodes(one)) - 1 <= most
    ]


def parameters_of_type(trees: Trees, name: str) -> int:
    """Return the number of parameters that are annotated with a type of this name."""
    parameters = (
        given.annotation
        for one in functions(trees)
        for given in (*one.args.args, *one.args.kwonlyargs)
        if given.annotation
    )
    return sum(name in ast.unparse(annotation).split(" | ") for annotation in parameters)


def public(tree: ast.AST) -> Iterator[Documented]:
    """Return the functions and classes whose names do not begin with an underscore, also nested ones."""
    return (node for node in nodes(tree) if isinstance(node, Documented) and not node.name.startswith("_"))


def lines_of(path: Path) -> list[str]:
    """Return the lines of a file, by its path from the root."""
    return (ROOT / path).read_text(encoding="utf-8").splitlines()
