"""Results of single frames kept while an evaluation runs, so that one that was killed goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError

VERSION = 2  # of what a kept result says


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn a folder that cannot be written to into an error that says so."""
    try:
        yield
    except OSError as error:
        raise ArchiveError(f"cannot write to {folder}: {error.strerror}; choose another --out") from error


@dataclass(frozen=True)
class KeptResults:
    """A folder of results by what they follow from; without a folder nothing is kept."""

    folder: Path | None

    def made(self, what: str, follows_from: dict[str, Any], make: Callable[[], dict[str, Any] | None]) -> Any:
        """Give the result that was kept, or make it and keep it: whole or not at all. A damaged one is made again."""
        if self.folder is None:
            return make()
        text = json.dumps([VERSION, what, follows_from], sort_keys=True)
        path = self.folder / f"{what}-{hashlib.sha256(text.encode()).hexdigest()[:20]}.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))["result"]
        except (OSError, ValueError, LookupError, TypeError):
            result = make()
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(path.name + ".part")
            temporary.write_text(json.dumps({"follows_from": follows_from, "result": result}), encoding="utf-8")
            temporary.replace(path)
        return result
