"""Which processes descend from one, which of them listens at a port, and whether they are alive (Linux)."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

PROC = Path("/proc")
LISTENS = "0A"  # state of a socket in /proc/net/tcp


def children_of(pid: int) -> list[int]:
    """All that descend from a process, it not included."""
    parents: dict[int, list[int]] = {}
    for path in PROC.glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            parent = int(path.read_text().rpartition(")")[2].split()[1])
            parents.setdefault(parent, []).append(int(path.parent.name))
    found, looked = [pid], 0
    while looked < len(found):
        found += parents.get(found[looked], [])
        looked += 1
    return found[1:]


def listener_at(port: int, among: list[int]) -> int | None:
    """Which of some processes listens at a port of this machine."""
    inodes = set()
    for line in (PROC / "net/tcp").read_text().splitlines()[1:]:
        parts = line.split()
        if parts[3] == LISTENS and int(parts[1].rpartition(":")[2], 16) == port:
            inodes.add(f"socket:[{parts[9]}]")
    for pid in among:
        with suppress(OSError):
            if any(str(path.readlink()) in inodes for path in (PROC / str(pid) / "fd").iterdir()):
                return pid
    return None


def is_alive(pid: int) -> bool:
    """Whether a process is there, and not only waited for."""
    with suppress(OSError):
        return (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def words_of(pid: int) -> str:
    """The command line of a process; empty where it is gone."""
    with suppress(OSError):
        return (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    return ""
