"""Pages for people from the templates beside this file: one file each, which opens from disk and loads nothing.

Whatever a page shows is escaped here and nowhere else: no markup, and nothing that turns the words beside it round.
"""

from __future__ import annotations

import json
from functools import cache, partial
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from flows.publish.effect_table import format_change
from flows.terminal.figures import format_bytes, format_percent, format_points, format_seconds
from pipeline.errors import visible

_MARKDOWN = "\\`*_{}[]<>#|"


def render_page(template: str, **facts: Any) -> str:
    """Fill in an HTML template; every word of ``facts`` that is no `Markup` is escaped."""
    return visible(_html().get_template(template).render(facts))


def render_markdown(template: str, **facts: Any) -> str:
    """Fill in a Markdown template; in words that are no `Markup` nothing has a meaning of its own."""
    return visible(_markdown().get_template(template).render(facts))


_environment = partial(
    Environment, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
)


@cache
def _html() -> Environment:
    found = _environment(loader=_templates(), autoescape=True)
    found.filters |= {
        "bytes": format_bytes,
        "change": format_change,
        "percent": format_percent,
        "points": format_points,
        "seconds": format_seconds,
        "json": partial(json.dumps, ensure_ascii=False),
    }
    return found


@cache
def _markdown() -> Environment:
    return _environment(loader=_templates(), finalize=_plain)


def _templates() -> PackageLoader:
    return PackageLoader("flows.publish", "templates")


def _plain(value: object) -> object:
    """Words as Markdown shows them letter by letter."""
    if isinstance(value, Markup):
        return value
    return "".join(f"\\{letter}" if letter in _MARKDOWN else letter for letter in visible(str(value)))
