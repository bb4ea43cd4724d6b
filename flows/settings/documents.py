"""Write the declared settings as `survey.example.toml`, as the manual's table, and as the help of flags.

`python -m spectralzoom.flows.settings.documents > survey.example.toml` writes the example anew.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING

from spectralzoom.flows.settings.load import SURVEY, TABLES, Declared

WIDTH = 120
COLUMN = 38  # of the help in the example
HEAD = """\
# Settings of one survey: spectralzoom survey survey.example.toml
# Each line states the default, or an example behind a #. Flags override it. Relative paths start at this folder.
"""


def about(one: Declared, *, choices: bool = True) -> str:
    """Return the help of a setting, with its unit, its choices, and the source of its default."""
    unit = f" [{one.about['unit']}]" if one.about["unit"] else ""
    listed = f" ({one.listed})" if one.choices and choices else ""
    source = f"; {one.about['source']}" if one.about["source"] else ""
    return f"{one.item.metadata['description']}{unit}{listed}{source}"


def toml_value(one: Declared) -> str:
    """Return the default of a setting, or an example value, as TOML."""
    return as_toml(one.item.default if one.about["example"] is None else one.about["example"])


def as_toml(value: object) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(map(as_toml, value))}]" if isinstance(value, tuple) else str(value)


def example_toml() -> str:
    """Return the example file: each key with its default, commented out where it has none, and its help."""
    lines = [HEAD, *(line for name, one in SURVEY.items() if name not in TABLES for line in _example_lines(name, one))]
    for name, keys in TABLES.items():
        off = SURVEY[name].item.default is None or all(one.item.default is None for one in keys.values())
        lines += ["", *(f"# {line}" for line in textwrap.wrap(SURVEY[name].item.metadata["description"], WIDTH - 2))]
        lines += [f"# [{name}]" if off else f"[{name}]"]
        lines += [line for key, one in keys.items() for line in _example_lines(key, one, off=off)]
    return "\n".join(lines) + "\n"


def _example_lines(name: str, one: Declared, *, off: bool = False) -> Iterator[str]:
    sign = "# " if off or one.item.default in (None, MISSING, "") else ""
    help_lines = textwrap.wrap(about(one), WIDTH - COLUMN - 2, break_on_hyphens=False)
    yield f"{sign}{name} = {toml_value(one)}".ljust(COLUMN - 1) + f" # {help_lines[0]}"
    yield from (" " * COLUMN + f"# {more}" for more in help_lines[1:])


def settings_table() -> str:
    """Return the settings of every table as Markdown: default, allowed values and help."""
    parts = []
    for title, keys in {"": {k: v for k, v in SURVEY.items() if k not in TABLES}, **TABLES}.items():
        heading = f"## [{title}]\n\n{SURVEY[title].item.metadata['description']}\n\n" if title else ""
        shown = {MISSING: "to be given", None: "", "": ""}
        rows = [
            f"| `{name}` | {shown.get(one.item.default, f'`{toml_value(one)}`')} | "
            f"{'' if one.kind is str else one.expected} | {about(one, choices=False)} |"
            for name, one in keys.items()
        ]
        parts.append(
            heading + "\n".join(["| key | default | allowed values | meaning |", "|---|---|---|---|", *rows]) + "\n"
        )
    return "\n".join(parts)


if __name__ == "__main__":
    sys.stdout.write(example_toml())
