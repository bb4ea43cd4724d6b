"""Mutated ENVI headers: each gives a cube or one clear error, in no time and in no more memory than the files take.

The full run, with its table:  python tests/faults/mutated_headers.py 10000
"""

from __future__ import annotations

import os
import random
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from pipeline.errors import PipelineError
from storage.readers.envi_cubes import parse_envi_header
from tests.faults.cube_files import try_reading

LARGEST_DATA = 200_000  # bytes
SPARE_BYTES = 1 << 20  # what Python itself takes, whatever the files hold
TIMES_HEADER = 80  # a header's text becomes lines, fields, words and numbers
WORDS = (
    "-1", "0", "1", "2", "1000000000000", "99999999999999999999999999", "1e300", "1e400", "nan", "inf", "-0", "0x10",
    "4.5", "", "{", "}", "{{", "{}", "\\{", "=", ";", ",", "\0", "\ufeff", "\u0663", "1_000", "16000", "bil", "bsq",
    "ENVI Spectral Library", "Micrometers", "../../../etc/passwd", "__import__('os')", "\r\n", "é" * 40, "{" * 500,
)  # fmt: skip
KEYS = ("samples", "lines", "bands", "header offset", "data type", "interleave", "byte order", "wavelength", "fwhm",
        "wavelength units", "file type", "data ignore value", "band names", "description")  # fmt: skip
HAND_MADE = (
    "ENVI\nsamples = 4\nlines = 3\nbands = 2\ndata type = 12\ninterleave = bil\nbyte order = 0\n",
    "ENVI\nsamples = 5\nbands = 3\ndata type = 4\ninterleave = bsq\nbyte order = 1\nheader offset = 16\n"
    "wavelength units = um\nwavelength = {0.4,\n 0.5,\n 0.6}\nfwhm = {0.01, 0.01, 0.01}\n",
    "ENVI\n;Exposure (ms) = 4.5\nsamples = 2\nlines = 100\nbands = 2\ndata type = 2\ninterleave = bip\n"
    "description = {\n nested {one} two }\ndata ignore value = -9999\nwavelength = {\n400.0\n,500.0\n}\n",
    "ENVI\nsamples = 1\nlines = 1000000000000\nbands = 1\ndata type = 1\ninterleave = bsq\n",
    "ENVI\nsamples = 1000000000000\nlines = 3\nbands = 1000000\ndata type = 5\ninterleave = bip\n",
)  # fmt: skip


@dataclass
class Outcomes:
    """How the readings ended."""

    read: int = 0
    refused: Counter[str] = field(default_factory=Counter)  # by the error's class
    wrong: list[str] = field(default_factory=list)  # what no reading may do
    slowest_s: float = 0.0
    most_bytes: int = 0  # beyond what the files take

    def table(self) -> str:
        """The figures in lines."""
        refused = ", ".join(f"{name} {count}" for name, count in self.refused.most_common()) or "none"
        return (
            f"read      {self.read}\nrefused   {sum(self.refused.values())} ({refused})\nwrong     {len(self.wrong)}\n"
            f"slowest   {self.slowest_s * 1000:.0f} ms\nmemory    {self.most_bytes / 1e6:.2f} MB beyond the files"
        )


def seeds(folder: Path | None) -> list[str]:
    """Texts to begin from: hand-made headers, and the real ones of a folder."""
    real = [] if folder is None else sorted(folder.glob("*.hdr"))
    return [*HAND_MADE, *(path.read_bytes().decode("latin-1") for path in real)]


def mutate(text: str, rng: random.Random) -> str:
    """One to four random changes of a header's text: its values, keys, lines, characters."""
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
    """The same header for a cube of a few lines and samples, so that a small file can hold it."""
    lines = text.split("\n")
    for key, most in (("samples", 6), ("lines", 12)):
        lines = _set(lines, key, str(rng.randint(1, most)))
    return "\n".join(lines)


def data_for(text: str, rng: random.Random) -> bytes:
    """Bytes that hold what a header promises, some fewer or more of them, or any number where it promises nothing."""
    try:
        header = parse_envi_header(text)
        row = header.samples * header.bands * header.dtype.itemsize
        size = header.offset + row * (5 if header.lines is None else header.lines)
    except PipelineError:
        size = rng.choice((0, 47, 4000))
    share = rng.choice((1.0, 1.0, 1.0, 0.0, 0.5, 0.99, 1.01))
    return rng.randbytes(min(int(size * share), LARGEST_DATA))


def _set(lines: list[str], key: str, word: str) -> list[str]:
    return [f"{key} = {word}" if line.split("=")[0].strip() == key else line for line in lines]


def try_headers(count: int, folder: Path | None, seed: int = 0) -> Outcomes:
    """Mutate ``count`` headers, read each with a data file of a few KB beside it, and say how it went."""
    rng = random.Random(seed)
    texts, outcomes = seeds(folder), Outcomes()
    with tempfile.TemporaryDirectory() as name:
        for number in range(count):
            header = Path(name) / "a.hdr"
            whole = rng.choice(texts)
            text = small(whole, rng) if rng.random() < 0.8 else whole
            header.with_suffix(".bin").write_bytes(data_for(text, rng))
            header.write_bytes(mutate(text, rng).encode("utf-8", "surrogateescape"))
            _try_one(header, number, outcomes)
    return outcomes


def _try_one(header: Path, number: int, outcomes: Outcomes) -> None:
    size = header.with_suffix(".bin").stat().st_size
    allowed = SPARE_BYTES + size * 4 + header.stat().st_size * TIMES_HEADER
    found = try_reading(header)
    outcomes.read += found.refused is None and found.wrong is None
    if found.refused is not None:
        outcomes.refused[found.refused] += 1
    if found.wrong is not None:
        outcomes.wrong.append(f"{number}: {found.wrong}")
    outcomes.slowest_s = max(outcomes.slowest_s, found.seconds)
    outcomes.most_bytes = max(outcomes.most_bytes, found.peak_bytes - size)
    if found.peak_bytes > allowed:
        outcomes.wrong.append(f"{number}: {found.peak_bytes} bytes of memory for {size} of data")


def real_headers() -> Path | None:
    """Folder of headers that instruments wrote, or None."""
    root = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    return root / "envi_headers" if (root / "envi_headers").is_dir() else None


if __name__ == "__main__":
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    folder = real_headers()
    found = try_headers(wanted, folder)
    print(f"{wanted} mutated headers, from {len(seeds(folder))}")
    print(found.table())
    for line in found.wrong[:20]:
        print(f"  {line}")
    sys.exit(1 if found.wrong else 0)
