"""Flip one bit at random places of an archive, one at a time: ``python tests/faults/flips.py ARCHIVE 200``.

Each must be found by verify, with the store's or run's address. The archive is put back as it was.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

from storage.archive.archive import Archive


def main(root: Path, flips: int, seed: int = 0) -> int:
    archive = Archive.open(root, create=False, write=False)
    folders = [ref.path for ref in archive.refs()] + archive.runs()
    files = sorted(path for folder in folders for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
    sizes = [path.stat().st_size for path in files]
    rng, found, named = random.Random(seed), 0, 0
    for path in rng.choices(files, sizes, k=flips):
        whole = path.read_bytes()
        place, bit = rng.randrange(len(whole)), rng.randrange(8)
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << bit]) + whole[place + 1 :])
        try:
            problems = [finding for finding in archive.verify_all() if finding.problem is not None]
        finally:
            path.write_bytes(whole)
        found += bool(problems)
        named += any(path.relative_to(root.absolute()).is_relative_to(finding.uri) for finding in problems)
    left = sum(finding.problem is not None for finding in archive.verify_all())
    print(f"{flips} bits flipped: {found} found, {named} with the address; {left} left after putting back")
    return int(found < flips or named < flips or left > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 200))
