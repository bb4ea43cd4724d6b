"""Parts that all pages for people share: sections, tables, and cells that are already escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape as escape_html

from pipeline.visible_text import visible


def escape(text: str) -> str:
    """Words as a page may hold them: no markup, and nothing that turns the words beside them round."""
    return escape_html(visible(text))


def page_section(title: str, body: str) -> str:
    """A section under its heading."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def page_table(rows: Iterable[str]) -> str:
    """A table that scrolls by itself where it is too wide."""
    return f'<div class="wide"><table>{"".join(rows)}</table></div>'


def page_row(tag: str, cells: Iterable[str]) -> str:
    """A table row of cells that are already escaped; ``tag`` is th or td."""
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
