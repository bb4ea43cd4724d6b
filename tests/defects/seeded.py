"""Read the list of seeded defects, and apply them to a copy of the source tree."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from tests.source_paths import python_path

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("defects.toml")
PACKAGES = ("spectralzoom", *(f"spectralzoom.{name}" for name in ("flows", "models", "pipeline", "storage")))
MOST_SECONDS = 600  # of the tests of one defect; a survey that never ends is noticed too


@dataclass(frozen=True)
class Defect:
    """A slip in one file: ``old`` becomes ``new``, and one of ``tests`` (files or node ids) should fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    @property
    def area(self) -> str:
        """Return the part of the project that the name begins with."""
        return self.name.partition("-")[0]

    def problem(self, root: Path) -> str | None:
        """Return why it cannot be applied to a tree, None if it can."""
        place = root / self.file
        found = place.read_text(encoding="utf-8").count(self.old) if place.is_file() else 0
        if found != 1:
            return f"its text occurs {found} times in {self.file}, expected once"
        missing = [one for one in self.tests if not (root / one.partition("::")[0]).is_file()]
        return f"there is no {missing[0]}" if missing else None

    def applied(self, text: str) -> str:
        """Return the text of its file with the defect."""
        return text.replace(self.old, self.new)


def read_defects(pattern: str = "") -> list[Defect]:
    """Return the defects in whose name a regular expression is found, in the order of the list."""
    listed = tomllib.loads(LIST.read_text(encoding="utf-8"))["defect"]
    return [Defect(**one | {"tests": tuple(one["tests"])}) for one in listed if re.search(pattern, one["name"])]


@dataclass
class TreeCopy:
    """A copy of the tracked and new files of this checkout, whose code is imported in place of the installed one."""

    root: Path
    _changes: count[int] = field(default_factory=lambda: count(1))

    @classmethod
    def made(cls, root: Path) -> TreeCopy:
        """Copy the tree, and check that Python imports its packages. RuntimeError: it imports others."""
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout.decode()
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, root / name)
            elif (ROOT / name).is_symlink():  # the folders by their import names
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                (root / name).symlink_to((ROOT / name).readlink())
        copy = cls(root)
        code = "import importlib, sys\nfor name in sys.argv[1:]: print(importlib.import_module(name).__file__)"
        places = copy.python("-c", code, *PACKAGES).stdout.split()
        if not all(Path(place).resolve().is_relative_to(root.resolve()) for place in places):
            raise RuntimeError(f"Python imports {places}, expected the copy {root}")
        return copy

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Python in the copy; a run that does not end in time has the code 124."""
        known = dict(os.environ) | {"OMP_NUM_THREADS": "1", "PYTHONPATH": python_path(self.root)}
        command = [sys.executable, *arguments]
        try:
            return subprocess.run(
                command, cwd=self.root, env=known, capture_output=True, text=True, check=False, timeout=MOST_SECONDS
            )
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, 124, "", "")

    def failing(self, tests: Iterable[str], *options: str) -> list[str]:
        """Run some tests, and return those that fail."""
        run = self.python("-m", "pytest", "-q", "-p", "no:cacheprovider", *options, *tests)
        if run.returncode == 0:
            return []
        lines = [line for line in run.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        found = [line.partition(" ")[2].partition(" - ")[0] for line in lines]
        return found or [f"pytest ends with code {run.returncode}"]

    def caught_by(self, defect: Defect, tests: Sequence[str]) -> str | None:
        """Return the test that fails with a defect, None where all pass; the copy is whole again afterwards."""
        place = self.root / defect.file
        before = place.read_text(encoding="utf-8")
        self._write(place, defect.applied(before))
        try:
            return next(iter(self.failing(tests, "-x")), None)
        finally:
            self._write(place, before)

    def _write(self, place: Path, text: str) -> None:
        """Write a file with a date of its own, by whole seconds: compiled code is kept by date and size."""
        place.write_text(text, encoding="utf-8")
        date = (ROOT / place.relative_to(self.root)).stat().st_mtime + next(self._changes)
        os.utime(place, (date, date))
