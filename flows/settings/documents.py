"""The declared settings in words: `survey.example.toml`, the table of the documents, and a flag's help.

`python -m flows.settings.documents > survey.example.toml` writes the example anew.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING

from flows.settings.load import SURVEY, TABLES, Declared

WIDTH = 120
COLUMN = 38  # where the words of a line of the example begin
HEAD = """\
# Settings of one survey: spectralzoom survey survey.example.toml
# Every line says the default; a flag of the same name wins. Relative paths start at this file's folder.
"""


def about(one: Declared, *, choices: bool = True) -> str:
    """The line of help of a setting, with its unit, its choices, and whether its default is assumed."""
    unit = f" [{one.about['unit']}]" if one.about["unit"] else ""
    words = f" ({one.listed})" if one.choices and choices else ""
    source = f"; {one.about['source']}" if one.about["source"] else ""
    return f"{one.item.metadata['description']}{unit}{words}{source}"


def shown(one: Declared) -> str:
    """A setting's default, or an example of it, as TOML writes it."""
    default, example = one.item.default, one.about["example"]
    value = default if example is None else example
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)


def example_toml() -> str:
    """The settings' example: every key with its default (in a comment where it has none) and its line of help."""
    lines = [HEAD, *(line for name, one in SURVEY.items() if name not in TABLES for line in _example_lines(name, one))]
    for name, keys in TABLES.items():
        off = SURVEY[name].item.default is None or all(one.item.default is None for one in keys.values())
        lines += ["", *(f"# {line}" for line in textwrap.wrap(SURVEY[name].item.metadata["description"], WIDTH - 2))]
        lines += [f"# [{name}]" if off else f"[{name}]"]
        lines += [line for key, one in keys.items() for line in _example_lines(key, one, off=off)]
    return "\n".join(lines) + "\n"


def _example_lines(name: str, one: Declared, *, off: bool = False) -> Iterator[str]:
    sign = "# " if off or one.item.default in (None, MISSING, "") else ""
    words = textwrap.wrap(about(one), WIDTH - COLUMN - 2, break_on_hyphens=False)
    yield f"{sign}{name} = {shown(one)}".ljust(COLUMN - 1) + f" # {words[0]}"
    yield from (" " * COLUMN + f"# {more}" for more in words[1:])


def settings_table() -> str:
    """Markdown: every setting of every table with its default, what it may be, and its line of help."""
    parts = []
    for title, keys in {"": {k: v for k, v in SURVEY.items() if k not in TABLES}, **TABLES}.items():
        said = f"## [{title}]\n\n{SURVEY[title].item.metadata['description']}\n\n" if title else ""
        rows = [
            f"| `{name}` | {_default(one)} | {'' if one.kind is str else one.expected} | {about(one, choices=False)} |"
            for name, one in keys.items()
        ]
        parts.append(said + "\n".join(["| key | default | may be | what it is |", "|---|---|---|---|", *rows]) + "\n")
    return "\n".join(parts)


def _default(one: Declared) -> str:
    if one.item.default is MISSING:
        return "to be given"
    return "" if one.item.default in (None, "") else f"`{shown(one)}`"


if __name__ == "__main__":
    sys.stdout.write(example_toml())
