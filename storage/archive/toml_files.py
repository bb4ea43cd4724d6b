"""TOML files that people write: read whole or refused in one sentence, whatever they hold."""

from __future__ import annotations

import os
import stat
import sys
import tomllib
from pathlib import Path
from typing import Any

MOST_BYTES = 10_000_000  # settings are a page long


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file; a byte order mark, as some editors write it, is passed over.

    Raises
    ------
    FileNotFoundError : there is no such file.
    ValueError : it cannot be read as TOML; the message says why.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise ValueError("it is no plain file")
            if found.st_size > MOST_BYTES:
                raise ValueError(f"it has {found.st_size} bytes, settings have a few thousand")
            text = file.read().decode("utf-8-sig")
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(str(error)) from error
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its lists or tables are nested too deeply") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # int() of very many digits
        raise ValueError(f"it has a number of more than {sys.get_int_max_str_digits()} digits") from error
