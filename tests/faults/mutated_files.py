"""Mutate files of every format that is read: each must give a cube or one clear error, soon, in bounded memory.

``python tests/faults headers files`` changes values, keys, lines and characters of ENVI headers, real and made. It also
flips, overwrites, cuts, doubles and moves bytes in small files of each format. Each cube is opened and read.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.envi_headers import parse_envi_header
from spectralzoom.pipeline.errors import PipelineError
from tests.faults.cube_files import FORMATS, try_reading
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import ROOT

BATCH = 500  # mutations in one process
RATIO = 1100  # zlib's limit: compressed files may hold this many times their bytes
SPARE_BYTES = 24 << 20  # memory that libraries need at their first use
LARGEST_DATA = 200_000  # bytes
SPARE_OF_HEADERS = 1 << 20  # memory that Python itself needs
TIMES_HEADER = 80  # a header's text becomes lines, fields, words and numbers
ODD_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 1 << 20, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)
ODD_BYTES = (b"\x89HDF", b"PK\3\4", b"-1", b"1e9", b"9" * 12, b"..", b"../../x", b"null", b"{}", b"[[[[", b"nan")
PLAIN_WORDS = (
    "-1 0 1 2 1000000000000 99999999999999999999999999 1e300 1e400 nan inf -0 0x10 4.5 { } {{ {} \\{ = ; , 1_000 16000 "
    "bil bsq Micrometers ../../../etc/passwd __import__('os')"
)
WORDS = (*PLAIN_WORDS.split(), "", "\0", "\ufeff", "\u0663", "ENVI Spectral Library", "\r\n", "é" * 40, "{" * 500)
PLAIN_KEYS = "samples lines bands interleave wavelength fwhm description"
LONG_KEYS = "header offset,data type,byte order,wavelength units,file type,data ignore value,band names"
KEYS = (*PLAIN_KEYS.split(), *LONG_KEYS.split(","))
HAND_MADE = (
    "ENVI\nsamples = 4\nlines = 3\nbands = 2\ndata type = 12\ninterleave = bil\nbyte order = 0\n",
    "ENVI\nsamples = 5\nbands = 3\ndata type = 4\ninterleave = bsq\nbyte order = 1\nheader offset = 16\n"
    "wavelength units = um\nwavelength = {0.4,\n 0.5,\n 0.6}\nfwhm = {0.01, 0.01, 0.01}\n",
    "ENVI\n;Exposure (ms) = 4.5\nsamples = 2\nlines = 100\nbands = 2\ndata type = 2\ninterleave = bip\n"
    "description = {\n nested {one} two }\ndata ignore value = -9999\nwavelength = {\n400.0\n,500.0\n}\n",
    "ENVI\nsamples = 1\nlines = 1000000000000\nbands = 1\ndata type = 1\ninterleave = bsq\n",
    "ENVI\nsamples = 1000000000000\nlines = 3\nbands = 1000000\ndata type = 5\ninterleave = bip\n",
)


@dataclass
class Tally:
    """Count the results of reading one kind of file."""

    read: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    most_bytes: int = 0
    wrong: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add the counts of another tally."""
        self.read += other.read
        self.refused += other.refused
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        self.most_bytes = max(self.most_bytes, other.most_bytes)
        self.wrong += other.wrong

    def words(self) -> str:
        """Return the figures as text."""
        return (
            f"{self.read} read, {self.refused} refused, {reported_wrong(self.wrong)}; slowest "
            f"{self.slowest_s * 1000:.0f} ms, {self.most_bytes / 1e6:.1f} MB at most"
        )

    def try_one(self, address: Path, most_bytes: int, called: str) -> None:
        """Open one source, read its first and last lines, and check the peak memory."""
        found = try_reading(address)
        wrong = [] if found.wrong is None else [f"{called}: {found.wrong}"]
        if found.peak_bytes > most_bytes:
            wrong.append(f"{called}: {found.peak_bytes} bytes of memory, expected {most_bytes} at most")
        fine = found.refused is None and found.wrong is None
        self.add(Tally(int(fine), int(found.refused is not None), found.seconds, found.peak_bytes, wrong))


# --- headers ----------------------------------------------------------------------------------------------------------


def mutate_header(text: str, rng: random.Random) -> str:
    """Return a header's text with one to four random changes of values, keys, lines and characters."""
    for _ in range(rng.randint(1, 4)):
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        change = rng.randrange(9)
        if change == 0 and "=" in lines[at]:
            lines[at] = f"{lines[at].split('=')[0]}= {rng.choice(WORDS)}"
        elif change == 1:
            lines.insert(at, f"{rng.choice(KEYS)} = {rng.choice(WORDS)}")
        elif change == 2:
            lines = _set(lines, rng.choice(KEYS), rng.choice(WORDS))
        elif change == 3:
            del lines[at]
        elif change == 4:
            del lines[at : at + rng.choice((1, 2, 5, len(lines)))]
        elif change == 5:
            lines[at] = lines[at] * rng.choice((0, 2, 50))
        elif change == 6 and lines[at]:
            place = rng.randrange(len(lines[at]))
            lines[at] = lines[at][:place] + rng.choice(WORDS) + lines[at][place + 1 :]
        elif change == 7:
            rng.shuffle(lines)
        else:
            lines = lines[: at + 1] + lines[at:] * rng.randint(1, 3)
        text = "\n".join(lines)[: 1 << 18]
    return text


def small(text: str, rng: random.Random) -> str:
    """Return the header for a cube of a few lines and samples, which fits into a small file."""
    lines = text.split("\n")
    for key, most in (("samples", 6), ("lines", 12)):
        lines = _set(lines, key, str(rng.randint(1, most)))
    return "\n".join(lines)


def data_for(text: str, rng: random.Random) -> bytes:
    """Return as many bytes as the header needs, or slightly other sizes; random sizes for an invalid header."""
    try:
        header = parse_envi_header(text)
        row = header.samples * header.bands * header.dtype.itemsize
        size = header.offset + row * (5 if header.lines is None else header.lines)
    except PipelineError:
        size = rng.choice((0, 47, 4000))
    fraction = rng.choice((1.0, 1.0, 1.0, 0.0, 0.5, 0.99, 1.01))
    return rng.randbytes(min(int(size * fraction), LARGEST_DATA))


def _set(lines: list[str], key: str, word: str) -> list[str]:
    return [f"{key} = {word}" if line.split("=")[0].strip() == key else line for line in lines]


def try_headers(count: int, seed: int = 0) -> Tally:
    """Mutate ``count`` headers, read each with a data file of a few KB, and return the counts."""
    rng = random.Random(seed)
    tally = Tally()
    data_sets = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    real = sorted((data_sets / "envi_headers").glob("*.hdr"))  # that instruments wrote, if they are there
    texts = [*HAND_MADE, *(path.read_bytes().decode("latin-1") for path in real)]
    with tempfile.TemporaryDirectory() as name:
        header = Path(name) / "a.hdr"
        for text in texts:  # readers are imported before memory is measured
            header.with_suffix(".bin").write_bytes(data_for(text, random.Random(seed)))
            header.write_bytes(text.encode("latin-1"))
            try_reading(header)
        for number in range(count):
            whole = rng.choice(texts)
            text = small(whole, rng) if rng.random() < 0.8 else whole
            data = data_for(text, rng)
            made = mutate_header(text, rng).encode("utf-8", "surrogateescape")
            header.with_suffix(".bin").write_bytes(data)
            header.write_bytes(made)
            tally.try_one(header, SPARE_OF_HEADERS + 4 * len(data) + TIMES_HEADER * len(made), f"{number}")
    return tally


def header_rows(quick: bool = False) -> list[Row]:
    count = 500 if quick else 10_000
    found = try_headers(count)
    demanded = "a cube or one clear error, soon, in no more memory than the file's size"
    injected = "random changes in ENVI headers, real and made"
    return [Row("mutated headers", injected, count, demanded, found.words(), not found.wrong)]


# --- files ------------------------------------------------------------------------------------------------------------


def mutate(content: bytes, rng: random.Random) -> bytes:
    """Return the content with one to four random changes of bits, bytes, numbers and length; most near its start."""
    for _ in range(rng.randint(1, 4)):
        size = len(content)
        at = rng.randrange(min(size, 200) if rng.random() < 0.6 else size) if size else 0
        change = rng.randrange(9)
        if change == 0 and size:
            content = content[:at] + bytes([content[at] ^ (1 << rng.randrange(8))]) + content[at + 1 :]
        elif change == 1:
            content = content[:at] + rng.randbytes(rng.randint(1, 8)) + content[at + rng.randint(0, 8) :]
        elif change in (2, 3):
            layout = rng.choice(("<I", ">I", "<H", ">H")[: 2 if change == 2 else 4])
            number = struct.pack(layout, rng.choice([odd for odd in ODD_NUMBERS if change == 2 or odd < 1 << 16]))
            content = content[:at] + number + content[at + len(number) :]
        elif change == 4:
            content = content[:at] + rng.choice(ODD_BYTES) + content[at:]
        elif change == 5:
            content = content[: rng.randrange(size + 1)]
        elif change == 6:
            content = content[:at] + content[at + rng.choice((1, 2, 4, 8, 100)) :]
        elif change == 7:
            content = content[:at] + content[at : at + 64] + content[at:]
        else:
            content = content[:at] + bytes([rng.choice((0, 255))]) * rng.choice((1, 4, 16)) + content[at + 4 :]
    return content


def try_files(count: int, seed: int = 0) -> dict[str, Tally]:
    """Mutate ``count`` files, each format in turn, read each, and return the counts."""
    tallies = {name: Tally() for name in FORMATS}
    with tempfile.TemporaryDirectory() as place:
        sources = {name: Path(place, f"s{number}") for number, name in enumerate(FORMATS)}
        addresses = {}
        for name, make in FORMATS.items():
            sources[name].mkdir()
            addresses[name] = make(sources[name])
        for number in range(count):
            name = list(FORMATS)[number % len(FORMATS)]
            rng = random.Random(f"{seed}/{number}")
            folder = Path(place, "tried")
            shutil.copytree(sources[name], folder)
            files = sorted(file for file in folder.rglob("*") if file.is_file())
            chosen = rng.choice(files)
            chosen.write_bytes(mutate(chosen.read_bytes(), rng))
            most = SPARE_BYTES + RATIO * sum(file.stat().st_size for file in files)
            tallies[name].try_one(folder / addresses[name], most, f"{name}, seed {seed}, number {number}")
            shutil.rmtree(folder)
    return tallies


def file_rows(quick: bool = False) -> Sequence[Row]:
    """Return one row for all formats; each batch of ``BATCH`` files has its own process, so that a crash is found."""
    count = 100 if quick else 5000
    tally = Tally()
    crashed: list[str] = []
    grown = 0
    for seed in range(-(-count // BATCH)):
        command = [sys.executable, "-m", "tests.faults.mutated_files", str(min(BATCH, count - seed * BATCH)), str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
        if done.returncode != 0:
            crashed.append(f"the process of seed {seed} ended with {done.returncode}: {done.stderr[-400:]}")
            continue
        found = json.loads(done.stdout)
        grown = max(grown, found.pop("grown"))
        for one in found.values():
            tally.add(Tally(**one))
    words = [*crashed, tally.words(), f"a process of {BATCH} grew by {grown / 1e6:.0f} MB at most"]
    met = not crashed and not tally.wrong
    injected = "random changes in files of every kind that is read"
    demanded = "a cube or one clear error, soon, in bounded memory"
    return [Row("mutated files", injected, count, demanded, "; ".join(words), met)]


def _part(count: int, seed: int) -> None:
    try_files(len(FORMATS), seed + 10**6)  # libraries are loaded before memory is measured
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found: dict[str, Any] = {name: asdict(tally) for name, tally in try_files(count, seed).items()}
    found["grown"] = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    print(json.dumps(found))


if __name__ == "__main__":
    _part(int(sys.argv[1]), int(sys.argv[2]))
