"""Write tables as CSV whose cells no spreadsheet takes as formulas."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

_FORMULA = re.compile(r"""'|[\s"]*[=+\-@\uff0b\uff0d\uff1d\uff20]|[\t\r\n]""")


def csv_table(columns: Mapping[str, Sequence[object]]) -> str:
    """Return columns of equal length as CSV with a header.

    Text is quoted, so that no separator cuts it. If it begins with ``'`` or as a formula, another ``'`` comes before
    it. Floats have nine digits; NaN and None are empty.
    """
    rows = [list(columns), *zip(*columns.values(), strict=True)]
    return "".join(",".join(map(_cell, row)) + "\n" for row in rows)


def _cell(value: object) -> str:
    if isinstance(value, str):
        text = f"'{value}" if _FORMULA.match(value) else value
        return '"' + text.replace('"', '""') + '"'
    if value is None or value != value:
        return ""
    return f"{value:.9g}" if isinstance(value, float | np.floating) else f"{value}"
