"""Write the declared settings as `survey.example.toml` and as the manual's table.

`python -m spectralzoom.flows.settings.documents > survey.example.toml` writes the example anew.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator

from spectralzoom.flows.settings.load import Schema, allowed, declared, listed
from spectralzoom.flows.settings.settings import Settings

WIDTH = 120
COLUMN = 38  # of the help in the example
HEAD = """\
# Settings of one survey: spectralzoom survey survey.example.toml
# Each line states the default, or an example behind a #. Flags override it. Relative paths start at this folder.
"""


def about(one: Schema, *, usual: bool = False) -> str:
    """Return the help of a setting with unit, source of the default and choices; with ``usual``, also its default."""
    return str(one["description" if usual else "about"]) + (f" ({listed(one)})" if "enum" in one else "")


def example_toml() -> str:
    """Return the example file: each key with its default, commented out where it has none, and its help."""
    lines = [HEAD]
    for name, keys in declared(Settings).items():
        off = name == "pose" or all(one.get("usual") is None for one in keys.values())
        if name:
            description = Settings.model_fields[name].description or ""
            lines += ["", *(f"# {line}" for line in textwrap.wrap(description, WIDTH - 2))]
            lines.append(f"# [{name}]" if off else f"[{name}]")
        lines += [line for key, one in keys.items() for line in _example_lines(key, one, off=off and bool(name))]
    return "\n".join(lines) + "\n"


def _example_lines(name: str, one: Schema, *, off: bool) -> Iterator[str]:
    sign = "# " if off or one.get("usual") in (None, "") else ""
    help_lines = textwrap.wrap(about(one), WIDTH - COLUMN - 2, break_on_hyphens=False)
    yield f"{sign}{name} = {one['shown']}".ljust(COLUMN - 1) + f" # {help_lines[0]}"
    yield from (" " * COLUMN + f"# {more}" for more in help_lines[1:])


def settings_table() -> str:
    """Return the settings of every table as Markdown: default, allowed values and help."""
    parts = []
    for title, keys in declared(Settings).items():
        heading = f"## [{title}]\n\n{Settings.model_fields[title].description}\n\n" if title else ""
        rows = [f"| `{name}` | {_shown(one)} | {_values(one)} | {one['about']} |" for name, one in keys.items()]
        parts.append(
            heading + "\n".join(["| key | default | allowed values | meaning |", "|---|---|---|---|", *rows]) + "\n"
        )
    return "\n".join(parts)


def _shown(one: Schema) -> str:
    if "usual" not in one:
        return "to be given"
    return "" if one["usual"] in (None, "") else f"`{one['shown']}`"


def _values(one: Schema) -> str:
    return "" if one.get("type") == "string" and "enum" not in one else allowed(one)


if __name__ == "__main__":
    sys.stdout.write(example_toml())
