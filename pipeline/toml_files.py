"""Read and write TOML of users: settings of a survey, and what describes scenes."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

MOST_BYTES = 10_000_000  # settings are a page long


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, with or without a byte order mark.

    Raises FileNotFoundError: there is no such file. ValueError: it cannot be read as TOML.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():  # a pipe would be waited for
            raise ValueError("it is no plain file")
        if size > MOST_BYTES:
            raise ValueError(f"it has {size} bytes, settings have a few thousand")
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(str(error)) from error
    except RecursionError:
        raise ValueError("its lists or tables are nested too deeply") from None


def as_toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(map(as_toml, value))}]" if isinstance(value, tuple | list) else str(value)
