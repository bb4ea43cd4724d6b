"""The rules of plain English that a machine can check, over pages, docstrings and messages.

``python tests/house --language [PATH ...]`` prints every sentence that breaks one, with file, line and rule.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.house.source_tree import ROOT, Documented, files_of_tests, nodes, source

MOST_WORDS = 25  # in a sentence
MOST_NUMBERS = 2  # in a sentence
LEAST_WORDS = 4  # of a string that counts as a message
OPENERS = "what of where by beside which how who whoever whom whose"  # no sentence begins with one of these
PHRASES = (  # no text has one of these
    "nobody|anybody|somebody|everybody|whoever|no more (?!than)|promises?|believes?|believed|(?:is|are|was|were) told|"
    "tells? of|told of|goes on|go on|went on|as before|lets? go of|(?:says?|said) of|in the place of"
)
HISTORY = (  # only for the changelog and the log of measurements
    "no longer|formerly|former|used to|earlier versions?|the network before|weights before|"
    "(?:measured|trained) on 20\\d\\d|before 20\\d\\d|20\\d\\d-\\d\\d-\\d\\d"
)
UNITS = {  # last word of a number's name -> suffixes of its unit; a name ends with one of these
    **{"wavelength": ("nm",), "fwhm": ("nm", "px"), "exposure": ("ms", "s"), "altitude": ("m",)},
    **{"distance": ("m", "px", "km"), "focal": ("mm", "m"), "duration": ("s", "ms"), "timeout": ("s", "ms")},
}

_SENTENCE_END = re.compile(r"(?<=[.!?])[)\"']?\s+(?=[A-Z`*\[(\"{])")
_ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|cf|vs|etc|Fig|Eq|No|al|approx)\.\s")
_NUMBER = re.compile(  # 1280 x 1024 and 3 to 100 are one
    r"(?<![\w.])[-+]?(?:\d[\d ]*(?:[.,]\d+)?(?:\s?(?:x|to|-|:)\s?\d[\d ]*(?:\.\d+)?)*(?![\w-]*[A-Za-z])|\.\d+)"
)
_LIST = re.compile(r"^\s*(?:[-*+]|\d+\.)\s+")


@dataclass(frozen=True)
class Sentence:
    """A sentence and its place."""

    path: Path  # from the root
    line: int  # of the text that it stands in
    kind: str  # page, docstring or message
    text: str


def broken_rules(sentence: Sentence) -> Iterator[str]:
    """Yield the rules that a sentence breaks, each in a few words."""
    text = sentence.text
    words = re.findall(r"[^\W_]+(?:['.-][^\W_]+)*", re.sub(r"`[^`]*`|\{[^}]*\}", "code", text))
    fragment = sentence.kind == "message" and text[:1].islower()
    if words and words[0].lower() in OPENERS.split() and not fragment and not text.rstrip().endswith("?"):
        yield f"1: begins with {words[0]}"
    if len(words) > MOST_WORDS and sentence.kind != "message" and not text.startswith("Raises "):
        yield f"2: {len(words)} words"
    plain = re.sub(r"`[^`]*`|\{[^}]*\}", "", text)
    if sentence.kind == "page" and (numbers := len(_NUMBER.findall(plain))) > MOST_NUMBERS:
        yield f"4: {numbers} numbers"
    if found := re.search(rf"\b(?:{PHRASES})\b", plain, re.IGNORECASE):
        yield f"6: {found[0]}"
    if found := re.search(rf"\b(?:{HISTORY})\b", plain, re.IGNORECASE):
        yield f"7: {found[0]}"


def sentences_of_page(path: Path) -> Iterator[Sentence]:
    """Yield the sentences of a page: paragraphs and list items, without code, tables, headings and comments."""
    text = (ROOT / path).read_text(encoding="utf-8")
    text = re.sub(r"<!--.*?-->", _blank, text, flags=re.DOTALL)
    text = re.sub(r"^(`{3,})[^\n]*\n.*?^\1$", _blank, text, flags=re.DOTALL | re.MULTILINE)
    block: list[str] = []
    begin = 1
    for number, line in enumerate([*text.splitlines(), ""], 1):
        ends = not line.strip() or line.lstrip().startswith(("|", "#", ">")) or _LIST.match(line)
        if ends and block:
            yield from _split(path, begin, "page", " ".join(block))
            block = []
        if line.strip() and not line.lstrip().startswith(("|", "#")):
            begin = begin if block else number
            block.append(_LIST.sub("", line).strip("> "))


def sentences_of_code(path: Path, tree: ast.Module) -> Iterator[Sentence]:
    """Yield the sentences of a module's docstrings, and of the strings that it passes to functions or raises."""
    documented = [tree, *(node for node in nodes(tree) if isinstance(node, Documented))]
    inner = set()
    for node in documented:
        text = ast.get_docstring(node)
        if text is None:
            continue
        line = node.body[0].lineno
        inner.add(id(node.body[0].value))  # type: ignore[attr-defined]
        for paragraph in re.split(r"\n\s*\n|\n\s*(?=- |\[\d)", text):  # items of lists are apart
            if not re.search(r"----|\S {3,}\S|^\[\d", paragraph):  # no table, no reference to literature
                yield from _split(path, line, "docstring", re.sub(r"``([^`]*)``", r"`\1`", " ".join(paragraph.split())))
    joined = {id(part) for node in nodes(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            yield from _message(path, node.lineno, "".join(str(part) for part in parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner | joined:
            yield from _message(path, node.lineno, node.value)


def _message(path: Path, line: int, text: str) -> Iterator[Sentence]:
    if len(re.findall(r"[a-z]{2,}", text)) >= LEAST_WORDS and "<" not in text and "SELECT" not in text:
        yield from _split(path, line, "message", " ".join(text.split()))


def _split(path: Path, line: int, kind: str, text: str) -> Iterator[Sentence]:
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text).replace("**", "")
    text = _ABBREVIATION.sub(lambda found: found[0].replace(".", ""), text)
    yield from (Sentence(path, line, kind, one) for one in _SENTENCE_END.split(text) if one.strip())


def _blank(found: re.Match[str]) -> str:
    return "\n" * found[0].count("\n")


def names_without_unit(path: Path, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield parameters and fields that are plain numbers of a known quantity, but have no suffix of its unit."""
    for node in nodes(tree):
        if isinstance(node, ast.arg):
            name, annotation = node.arg, node.annotation
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name, annotation = node.target.id, node.annotation
        else:
            continue
        if annotation is not None and ast.unparse(annotation) in ("float", "int", "float | None", "int | None"):
            last = name.rstrip("s").split("_")[-1]
            if last in UNITS:
                yield node.lineno, name


def pages() -> list[Path]:
    """Return the pages that rules hold for: README and docs, without the changelog and the log of measurements."""
    found = [Path("README.md"), *((ROOT / "docs").rglob("*.md"))]
    paths = (path if not path.is_absolute() else path.relative_to(ROOT) for path in found)
    return sorted(path for path in paths if not {"_build", "measurements"} & set(path.parts))


@cache
def sentences() -> list[Sentence]:
    """Return every sentence of pages and code, and of the docstrings of tests."""
    found = [one for path in pages() for one in sentences_of_page(path)]
    found += [one for path, tree in source().items() for one in sentences_of_code(path, tree)]
    tests = ((path, ast.parse((ROOT / path).read_text(encoding="utf-8"))) for path in files_of_tests())
    return found + [one for each in tests for one in sentences_of_code(*each) if one.kind == "docstring"]


def violations(under: str = "") -> Iterator[tuple[Sentence, str]]:
    """Yield each sentence that breaks a rule, with the rule, in files whose path begins with ``under``."""
    for sentence in sentences():
        if sentence.path.as_posix().startswith(under):
            yield from ((sentence, rule) for rule in broken_rules(sentence))
    for path, tree in source().items():
        if path.as_posix().startswith(under):
            for line, name in names_without_unit(path, tree):
                yield Sentence(path, line, "name", name), f"10: {name} has no unit"
