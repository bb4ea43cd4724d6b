"""Code of a stage: every definition that its functions reach over the four packages, and a digest of it.

Names are followed from definition to definition (functions, classes, constants of a module): through imports, base
classes, decorators, default values and annotations. A class is reached as a whole. The first definition of a module
brings the module's registering statements. The digest uses syntax alone: layout, comments, docstrings and the file of a
definition are no part of it.

Modules imported by a name made at run time and implementations of a protocol are not followed. Such code needs roots of
its own.
"""

from __future__ import annotations

import ast
import gc
import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Any

RECORD = "stage"  # decorates a function with its record: no stored byte depends on it
PACKAGES = ("flows", "models", "pipeline", "storage")
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp
SCOPES = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda | COMPREHENSIONS

Target = tuple[str, str]  # a module by its dotted name, and a definition in it; "" for statements that define nothing


def read_packages(root: Path) -> dict[str, str]:
    """Return the text of every file of the four packages below a folder, by the module's dotted name."""
    texts = {}
    for file in sorted(file for package in PACKAGES for file in (root / package).rglob("*.py")):
        parts = file.relative_to(root).with_suffix("").parts
        texts[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file.read_text(encoding="utf-8")
    return texts


class Sources:
    """Modules by their dotted names, each parsed once."""

    def __init__(self, texts: Mapping[str, str]) -> None:
        collecting = gc.isenabled()
        gc.disable()  # four times as fast: a tree is many objects, of which none is garbage yet
        try:
            self.modules = {path: Module(self, path, ast.parse(text)) for path, text in texts.items()}
        finally:
            if collecting:
                gc.enable()

    def edited(self, path: str, text: str) -> Sources:
        """Return these sources with another text of one module that binds the same names; no other is parsed again."""
        changed = copy(self)
        changed.modules = self.modules | {path: Module(self, path, ast.parse(text))}
        if changed.modules[path].names != self.modules[path].names:
            raise LookupError(f"the new text of {path} binds other names")
        return changed

    def named(self, name: str) -> Target:
        """Return the only definition of that name: ``score``, or ``stages.score`` if several modules have one.

        Raises
        ------
        LookupError : there is none, or more than one.
        """
        where, _, short = name.rpartition(".")
        paths = [path for path, module in self.modules.items() if short in module.defined]
        found = [path for path in paths if not where or f".{path}".endswith(f".{where}")]
        if len(found) != 1:
            raise LookupError(f"expected one definition called {name}, found it in {found or 'no module'}")
        return found[0], short

    def names(self, target: Target) -> set[Target]:
        """Return the names that a definition uses and those that its module registers on import."""
        module = self.modules[target[0]]
        return {*module.registering, *(to for one in module.defined[target[1]] for to in one.named)}

    def closure(self, roots: Iterable[str], barriers: Collection[str] = ()) -> set[Target]:
        """Return every definition that the roots reach without passing one of the barriers."""
        ends = {self.named(name) for name in barriers}
        found: set[Target] = set()
        waiting = [self.named(name) for name in roots]
        while waiting:
            target = waiting.pop()
            if target not in found:
                found.add(target)
                waiting += self.names(target) - ends
        return found

    def digest(self, closure: Iterable[Target]) -> str:
        """Return a hash of the definitions' syntax, whatever their modules."""
        said = sorted((name, one.dump) for path, name in closure for one in self.modules[path].defined[name])
        return hashlib.sha256(repr(said).encode()).hexdigest()[:20]

    def resolve(self, dotted: str) -> tuple[str, set[Target]]:
        """Follow a dotted name through imports; return its name where it is defined, and the definitions it reaches."""
        parts = dotted.split(".")
        for count in range(len(parts), 0, -1):
            module = self.modules.get(".".join(parts[:count]))
            rest = parts[count:]
            if module is None:
                continue
            if not rest:  # the module itself, as a value
                return parts[-1], {(module.path, name) for name in module.defined}
            if rest[0] in module.defined:
                return ".".join(rest), {(module.path, rest[0])}
            if rest[0] in module.imported:
                return self.resolve(".".join((module.imported[rest[0]], *rest[1:])))
        return dotted, set()


class Module:
    """Names at the top of one file, with their definitions."""

    def __init__(self, sources: Sources, path: str, tree: ast.Module) -> None:
        self.sources = sources
        self.path = path
        self.imported: dict[str, str] = {}  # a name here -> a dotted name
        self.defined: dict[str, list[Definition]] = {}
        self._enter(tree.body)

    def _enter(self, body: Iterable[ast.stmt]) -> None:
        for node in body:
            match node:
                case ast.Import() | ast.ImportFrom():
                    self.imported.update(_imports([node]))
                case ast.If(test=ast.Name(id="TYPE_CHECKING"), body=inner):
                    self._enter(inner)
                case ast.If(test=ast.Compare(left=ast.Name(id="__name__"))) | ast.Expr(value=ast.Constant()):
                    pass
                case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef() | ast.Assign() | ast.AnnAssign():
                    self._define(node, _bound(_same_scope([node])) or {""})
                case _:
                    self.imported.update(_imports(ast.walk(node)))
                    self._define(node, {*_bound(_same_scope([node])), ""})

    def _define(self, node: ast.stmt, names: Iterable[str]) -> None:
        definition = Definition(self, node)
        for name in names:
            self.defined.setdefault(name, []).append(definition)

    @cached_property
    def names(self) -> dict[str, str]:
        """Return the dotted name of each name at the top of the file."""
        return self.imported | {name: f"{self.path}.{name}" for name in self.defined}

    @cached_property
    def registering(self) -> list[Target]:
        """Return the definitions that act on import: bare statements, and those decorated by our own functions."""
        return [(self.path, name) for name, ones in self.defined.items() if not name or any(x.registers for x in ones)]


class Definition:
    """One statement at the top of a file: its syntax without parts that have no effect, and the names it uses."""

    def __init__(self, module: Module, node: ast.stmt) -> None:
        self._module = module
        self._node = node
        if isinstance(node, ast.FunctionDef):
            node.decorator_list = [one for one in node.decorator_list if _decorator(one) != RECORD]
        self._decorators = [_decorator(one) for one in getattr(node, "decorator_list", ())]

    @property
    def registers(self) -> bool:
        """Return whether a function of the four packages decorates it."""
        known = self._module.names
        resolve = self._module.sources.resolve
        parts = (name.partition(".") for name in self._decorators)
        return any(resolve(f"{known[head]}{dot}{rest}")[1] for head, dot, rest in parts if head in known)

    @cached_property
    def _bare(self) -> tuple[str, set[Target]]:
        bare = _Bare(self._module)
        return ast.dump(bare.visit(self._node)), bare.named

    @property
    def dump(self) -> str:
        """Return the syntax, in which every import has the name of its definition."""
        return self._bare[0]

    @property
    def named(self) -> set[Target]:
        """Return the definitions whose names it uses."""
        return self._bare[1]


def _imports(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, str]]:
    """Yield the names that imports bind, each with its dotted name."""
    for node in nodes:
        match node:
            case ast.ImportFrom(module=module, names=names):
                yield from ((one.asname or one.name, f"{module}.{one.name}") for one in names)
            case ast.Import(names=names):
                for one in names:
                    first = one.name.partition(".")[0]
                    yield (one.asname, one.name) if one.asname else (first, first)


def _same_scope(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Yield nodes and their children, without the inside of functions, classes and comprehensions."""
    for node in nodes:
        yield node
        if not isinstance(node, SCOPES):
            yield from _same_scope(ast.iter_child_nodes(node))


def _bound(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the names that the nodes of one scope bind, without imports."""
    found: set[str] = set()
    for node in nodes:
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)):
                found.add(name)
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.MatchStar(name=str(name)) | ast.MatchMapping(rest=str(name)):
                found.add(name)
    return found


def _decorator(node: ast.expr) -> str:
    return ast.unparse(node).partition("(")[0]


def _parameters(node: ast.arguments) -> set[str]:
    return {one.arg for one in ast.walk(node) if isinstance(one, ast.arg)}


class _Bare(ast.NodeTransformer):
    """Transformer that drops docstrings and imports, gives imports the name of their definition, and records names."""

    def __init__(self, module: Module) -> None:
        self.named: set[Target] = set()
        self._module = module
        self._scopes: list[Mapping[str, str | None]] = []  # innermost last: local names, and what they import

    def visit(self, node: ast.AST) -> Any:
        match node:
            case ast.Import() | ast.ImportFrom() | ast.Expr(value=ast.Constant()):
                return None
            case ast.Name(id=name):
                return self._called(node, name, ())
            case ast.Attribute():
                return self._attribute(node)
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                return self._function(node)
            case ast.Lambda(args=parameters):
                return self._within(dict.fromkeys(_parameters(parameters)), node)
            case ast.ListComp() | ast.SetComp() | ast.DictComp() | ast.GeneratorExp():
                return self._within(dict.fromkeys(_bound(_same_scope(one.target for one in node.generators))), node)
            case ast.Call(func=ast.Name(id="cast"), args=[ast.Constant(value=str(kind)), *_]):
                node.args[0] = ast.parse(kind, mode="eval").body
        return self.generic_visit(node)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if getattr(node, "body", None) == []:
            node.body = [ast.Pass()]  # type: ignore[attr-defined]
        return node

    def _within(self, names: Mapping[str, str | None], node: ast.AST) -> ast.AST:
        """Visit the inside of a node that has names of its own."""
        self._scopes.append(names)
        self.generic_visit(node)
        self._scopes.pop()
        return node

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.AST:
        """Visit the body with its own names first, but decorators, default values and annotations without them."""
        body = ast.Module(node.body, [])
        node.body = []
        self.generic_visit(node)
        inside = list(_same_scope(body.body))
        shared = {name for one in inside if isinstance(one, ast.Global) for name in one.names}
        local = dict.fromkeys((_bound(inside) | _parameters(node.args)) - shared)
        self._within(local | dict(_imports(inside)), body)
        node.body = body.body
        return node

    def _attribute(self, node: ast.Attribute) -> ast.AST:
        names = [node.attr]
        inner = node.value
        while isinstance(inner, ast.Attribute):
            names = [inner.attr, *names]
            inner = inner.value
        return self._called(node, inner.id, names) if isinstance(inner, ast.Name) else self.generic_visit(node)

    def _called(self, node: ast.Name | ast.Attribute, name: str, attributes: Iterable[str]) -> ast.AST:
        """Return a global or imported name, as read, under the name of its definition."""
        scope = next((scope for scope in reversed(self._scopes) if name in scope), None)
        dotted = self._module.names.get(name) if scope is None else scope[name]
        if dotted is None:
            return node
        text, named = self._module.sources.resolve(".".join((dotted, *attributes)))
        self.named |= named
        return ast.Name(text, node.ctx)
