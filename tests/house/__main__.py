"""Print the figures that design rules limit: python tests/house [--journey | --language [PATH]].

With --journey a small survey runs too, to find the files that a simulated line passes; it takes half a minute.
With --language every sentence is printed that breaks a rule of plain English, in all files or those below PATH.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder: its modules are imported by their full names

from tests.benchmarks.measure import aligned  # noqa: E402
from tests.house.language import violations  # noqa: E402
from tests.house.source_tree import (  # noqa: E402
    ROOMS,
    circles,
    files_by_folder,
    files_of_tests,
    functions,
    imported_in_functions,
    inlinable,
    lines_of,
    parameters_of_type,
    shared_class_names,
    source,
    statements,
)

FEW = 3  # statements, at most, of a function that adds little to its name
SHORT = 60  # lines, below which a file is short
SURVEY = ("survey", "--scene", "farm", "--size", "192x160", "--seconds", "6", "--engine", "plain")


def main(arguments: Sequence[str]) -> int:
    """Print the table, and with flags the files that a line passes, or the broken rules of language."""
    if "--language" in arguments:
        for sentence, rule in violations("".join(arguments[1:2])):
            print(f"{sentence.path}:{sentence.line}: {sentence.kind}, rule {rule}\n    {sentence.text}")
        return 0
    print(aligned([("what", "is", "where"), *figures()], (52, 10, 60)))
    if "--journey" in arguments:
        passed = journey()
        camera = sum(file.startswith("pipeline/simulator/") for file in passed)
        words = f"{len(passed) - camera} files from the command to the map, and {camera} that simulate the camera"
        print(f"\nA line passes {words}:", *passed, sep="\n")
    return 0


def figures() -> Iterator[tuple[str, str, str]]:
    """Yield name, value and places of each figure of source and tests."""
    lines = {path: len(lines_of(path)) for path in source()}
    by_room = {room: sum(count for path, count in lines.items() if path.parts[0] == room) for room in ROOMS}
    yield "source lines", str(sum(lines.values())), ", ".join(f"{room} {count}" for room, count in by_room.items())
    yield "source files", str(len(lines)), ""
    yield "statements", str(statements(source())), ""
    small = inlinable(source(), FEW)
    yield "functions", str(len(list(functions(source())))), f"{len(small)} of at most {FEW} statements have one caller"
    yield "parameters that hold all Settings", str(parameters_of_type(source(), "Settings")), ""
    folder, most = files_by_folder([*source(), *files_of_tests()]).most_common(1)[0]
    yield "files in a folder, most", str(most), folder
    found = circles(source())
    yield "import circles", str(len(found)), "; ".join(found)
    inner = imported_in_functions(source())
    yield "files with imports inside functions", str(len(inner)), ", ".join(inner)
    faces = [path for path in lines if path.name == "__init__.py"]
    short = sorted(path.as_posix() for path, count in lines.items() if count < SHORT and path not in faces)
    yield f"files under {SHORT} lines, beside {len(faces)} __init__", str(len(short)), ", ".join(short)
    yield "longest file, lines", str(max(lines.values())), max(lines, key=lambda path: lines[path]).as_posix()
    yield "class names that collide", str(len(shared_class_names(source()))), ", ".join(shared_class_names(source()))
    yield "sentences that break a rule of plain English", str(len(list(violations()))), "see --language"
    skipped = sum("# fmt: skip" in line for path in lines for line in lines_of(path))
    yield "`# fmt: skip`", str(skipped), ""
    tests = files_of_tests()
    yield "lines of tests", str(sum(len(lines_of(path)) for path in tests)), f"{len(tests)} files"
    yield "lines of the README", str(len(lines_of(Path("README.md")))), ""


def journey() -> list[str]:
    """Run a small survey; return the files that pixels pass on their way to its class map."""
    from flows.cli.main import main as run
    from tests.house.journey import passed_files

    with tempfile.TemporaryDirectory(prefix="house-") as folder, passed_files() as passed:
        try:
            run([*SURVEY, "--out", folder])
        except SystemExit as left:
            if left.code:
                raise
    return sorted(passed)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
