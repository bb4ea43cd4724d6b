"""Read single stores and runs by manifest and receipt, whatever these files contain.

A damaged manifest gives a record with a ``problem``; values of another type than expected are ignored.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from spectralzoom.storage.archive.keys import StageRef, in_text
from spectralzoom.storage.archive.manifests import as_table, is_cleared, listed_bytes, try_manifest
from spectralzoom.storage.archive.staging import MANIFEST_NAME, file_hash

RECEIPT = "receipt.json"
YEARS = range(1900, 2201)
_DAY = re.compile(r"^\d{4}-\d\d-\d\d(?!\d)")
LINE_PRODUCTS = {"raw_coarse": "signal_coarse", "raw_fine": "signal_fine"}  # of a run: raw lines, and condensed ones
RESTS_ON = "rests_on"  # in a run's manifest: address of a store or of an input of it -> SHA-256 of its manifest.json


def moment_of(text: object) -> datetime | None:
    """Return the moment or day in ISO 8601 at the begin of a text, in UTC if it names no zone; else None."""
    if not isinstance(text, str) or not (words := text.split()):
        return None
    for some in (" ".join(words), " ".join(words[:2]), words[0], *_DAY.findall(words[0])):
        with suppress(ValueError):
            found = datetime.fromisoformat(some)
            return found.replace(tzinfo=found.tzinfo or UTC) if found.year in YEARS else None
    return None


@dataclass(frozen=True)
class Store:
    """One store by its manifest; of a damaged one ``problem`` is set and the rest is empty."""

    ref: StageRef
    facts: Mapping[str, Any] = field(default_factory=dict)
    problem: str | None = None
    cleared: bool = False  # whether its files were cleared away

    @property
    def version(self) -> str:
        """Version of the stage that made it."""
        return str(self.facts.get("version", ""))

    @property
    def params(self) -> dict[str, Any]:
        """Parameters that it was made with."""
        return as_table(self.facts.get("params"))

    @property
    def inputs(self) -> list[str]:
        """Keys of the stores that it was made of, in order."""
        inputs = self.facts.get("inputs")
        return [value for value in inputs if isinstance(value, str)] if isinstance(inputs, list) else []

    @property
    def created(self) -> str:
        """Time of publication, ISO 8601 in UTC; empty where not known."""
        return _text(self.facts.get("created"))

    @property
    def size(self) -> int:
        """Bytes of its files; 0 where they were cleared away."""
        return listed_bytes(self.facts) if self.facts and not self.cleared else 0


@dataclass(frozen=True)
class Run:
    """One run; a damaged ``receipt`` is empty."""

    folder: Path
    facts: Mapping[str, Any]  # of its manifest
    receipt: Mapping[str, Any]
    problem: str | None

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"runs/{self.folder.name}"

    @cached_property
    def names(self) -> frozenset[str]:
        """Return the addresses of its stores and of all their inputs; empty where its manifest is damaged."""
        return frozenset(uri for uri in as_table(self.facts.get(RESTS_ON)) if in_text(uri) == uri)

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings of the survey, from the receipt or else, rounded, from the manifest."""
        return as_table(self.receipt.get("settings")) or as_table(self.facts.get("settings"))

    @property
    def products(self) -> dict[str, str]:
        """Names and addresses of its products."""
        return {name: uri for name, uri in as_table(self.receipt.get("products")).items() if isinstance(uri, str)}

    @property
    def stages(self) -> list[dict[str, Any]]:
        """Its stages, each with name, key, state and costs."""
        rows = self.receipt.get("stages")
        return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []

    @property
    def created(self) -> str:
        """When it was published, ISO 8601 in UTC."""
        return _text(self.facts.get("created")) or _text(self.receipt.get("finished"))

    @property
    def simulated(self) -> bool:
        """Return whether its lines were simulated, and can be made again."""
        return self.settings.get("source") == "sim"


def read_store(ref: StageRef) -> Store:
    """Return one store by its manifest, damaged or not."""
    facts, problem = try_manifest(ref.path)
    return Store(ref, facts, problem and f"{MANIFEST_NAME} is damaged: {problem}", is_cleared(ref.path))


def read_run(folder: Path) -> Run:
    """Return one run by its manifest and receipt, damaged or not."""
    facts, broken = try_manifest(folder)
    problem = broken and f"{MANIFEST_NAME} is damaged: {broken}"
    receipt: dict[str, Any] = {}
    if broken is None and RECEIPT in facts["files"]:
        path = folder / RECEIPT
        try:
            if file_hash(path) == facts["files"][RECEIPT]["sha256"]:
                receipt = as_table(json.loads(path.read_bytes()))
            else:
                problem = f"{RECEIPT} has changed since it was published (its SHA-256 differs)"
        except (OSError, ValueError, RecursionError) as error:
            problem = f"{RECEIPT} cannot be read: {error.strerror if isinstance(error, OSError) else error}"
        if problem is not None and try_manifest(folder)[0] not in ({}, facts):  # something was added to it meanwhile
            return read_run(folder)
    return Run(folder, facts, receipt, problem)


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""
