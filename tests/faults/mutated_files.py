"""Mutated files of every kind that is ingested: each gives a cube or one clear error, soon, and in bounded memory.

Bytes are flipped, overwritten, cut, doubled and moved in small files of each format, and the cube is opened and read.
The full run, in processes of their own so that a crash is seen, with its table:  python tests/faults/mutated_files.py
"""

from __future__ import annotations

import json
import random
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.faults.cube_files import FORMATS, try_reading

BATCH = 500  # mutations a process
RATIO = 1100  # zlib's: files that pack numbers may hold this many times their bytes
SPARE_BYTES = 24 << 20  # what libraries take when they are first used
ODD_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 1 << 20, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)
ODD_WORDS = (
    b"-1",
    b"1e9",
    b"999999999999",
    b"..",
    b"../../x",
    b"null",
    b"{}",
    b"[[[[",
    b"nan",
    b"\x89HDF",
    b"PK\x03\x04",
)


@dataclass
class Tally:
    """How the readings of one format ended."""

    read: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    most_bytes: int = 0
    wrong: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Count another one's with this one's."""
        self.read += other.read
        self.refused += other.refused
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        self.most_bytes = max(self.most_bytes, other.most_bytes)
        self.wrong += other.wrong


# --- mutations --------------------------------------------------------------------------------------------------------


def mutate(content: bytes, rng: random.Random) -> bytes:
    """One to four random changes of bits, bytes, numbers and words, cuts and doubled parts; most near the beginning."""
    for _ in range(rng.randint(1, 4)):
        size = len(content)
        at = rng.randrange(min(size, 200) if rng.random() < 0.6 else size) if size else 0
        change = rng.randrange(9)
        if change == 0 and size:
            content = content[:at] + bytes([content[at] ^ (1 << rng.randrange(8))]) + content[at + 1 :]
        elif change == 1:
            content = content[:at] + rng.randbytes(rng.randint(1, 8)) + content[at + rng.randint(0, 8) :]
        elif change in (2, 3):
            number = struct.pack(rng.choice(("<I", ">I", "<H", ">H")[: 2 if change == 2 else 4]), _odd(rng, change))
            content = content[:at] + number + content[at + len(number) :]
        elif change == 4:
            content = content[:at] + rng.choice(ODD_WORDS) + content[at:]
        elif change == 5:
            content = content[: rng.randrange(size + 1)]
        elif change == 6:
            content = content[:at] + content[at + rng.choice((1, 2, 4, 8, 100)) :]
        elif change == 7:
            content = content[:at] + content[at : at + 64] + content[at:]
        else:
            content = content[:at] + bytes([rng.choice((0, 255))]) * rng.choice((1, 4, 16)) + content[at + 4 :]
    return content


def _odd(rng: random.Random, change: int) -> int:
    return (
        rng.choice(ODD_NUMBERS) if change == 2 else rng.choice([number for number in ODD_NUMBERS if number < 1 << 16])
    )


# --- trying -----------------------------------------------------------------------------------------------------------


def try_files(count: int, seed: int = 0) -> dict[str, Tally]:
    """Mutate ``count`` files, each format in turn, read each, and say how it went."""
    tallies = {name: Tally() for name in FORMATS}
    with tempfile.TemporaryDirectory() as place:
        sources = {name: Path(place, f"s{number}") for number, name in enumerate(FORMATS)}
        addresses = {}
        for name, make in FORMATS.items():
            sources[name].mkdir()
            addresses[name] = make(sources[name])
        names = list(FORMATS)
        for number in range(count):
            name = names[number % len(names)]
            rng = random.Random(f"{seed}/{number}")
            folder = Path(place, "tried")
            shutil.copytree(sources[name], folder)
            files = sorted(file for file in folder.rglob("*") if file.is_file())
            chosen = rng.choice(files)
            chosen.write_bytes(mutate(chosen.read_bytes(), rng))
            size = sum(file.stat().st_size for file in files)
            try_one(folder / addresses[name], size, tallies[name], f"{name}, seed {seed}, number {number}")
            shutil.rmtree(folder)
    return tallies


def try_one(address: Path, size: int, tally: Tally, called: str) -> None:
    """Open one source and read its first and last lines."""
    found = try_reading(address)
    tally.read += found.refused is None and found.wrong is None
    tally.refused += found.refused is not None
    tally.slowest_s = max(tally.slowest_s, found.seconds)
    tally.most_bytes = max(tally.most_bytes, found.peak_bytes)
    if found.wrong is not None:
        tally.wrong.append(f"{called}: {found.wrong}")
    if found.peak_bytes > SPARE_BYTES + RATIO * size:
        tally.wrong.append(f"{called}: {found.peak_bytes} bytes of memory for a file of {size}")


# --- the full run -----------------------------------------------------------------------------------------------------


def main(count: int = 5000) -> int:
    """Try ``count`` files in processes of ``BATCH``, print the table; 1 where anything went wrong."""
    tallies = {name: Tally() for name in FORMATS}
    grown = 0
    for seed in range(-(-count // BATCH)):
        wanted = min(BATCH, count - seed * BATCH)
        command = [sys.executable, __file__, "--part", str(wanted), str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
        if done.returncode != 0:
            tallies["ENVI"].wrong.append(
                f"the process of seed {seed} ended with {done.returncode}: {done.stderr[-400:]}"
            )
            continue
        found = json.loads(done.stdout)
        grown = max(grown, found.pop("grown"))
        for name, tally in found.items():
            tallies[name].add(Tally(**tally))
    print(_table(tallies, count, grown))
    return int(any(tally.wrong for tally in tallies.values()))


def _table(tallies: dict[str, Tally], count: int, grown: int) -> str:
    lines = [
        f"{count} mutated files",
        f"{'format':16} {'read':>6} {'refused':>8} {'wrong':>6} {'slowest':>9} {'memory':>9}",
    ]
    for name, tally in tallies.items():
        lines.append(
            f"{name:16} {tally.read:6} {tally.refused:8} {len(tally.wrong):6} {tally.slowest_s * 1000:6.0f} ms "
            f"{tally.most_bytes / 1e6:6.1f} MB"
        )
    kinds = Counter(line for tally in tallies.values() for line in tally.wrong[:20])
    lines.append(f"a process of {BATCH} grew by {grown / 1e6:.0f} MB at most")
    return "\n".join([*lines, *(f"  {line}" for line in kinds)])


def _part(count: int, seed: int) -> None:
    try_files(len(FORMATS), seed + 10**6)  # libraries are loaded before anything is measured
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found: dict[str, Any] = {name: asdict(tally) for name, tally in try_files(count, seed).items()}
    found["grown"] = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    print(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--part"]:
        _part(int(sys.argv[2]), int(sys.argv[3]))
    else:
        sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 5000))
