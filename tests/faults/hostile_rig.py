"""A camera and a mirror that mean harm, and a line that changes bytes: python tests/faults hostile_rig.

Random replies in place of every one that the protocols have: whole, torn, mangled, in pieces, a byte now and then,
without end, or none. Whoever asks is done by the deadline that its settings make, with one message, in bounded memory;
and no survey through a line that puts in, doubles or cuts out bytes ends with others than without it in silence.
"""

from __future__ import annotations

import logging
import resource
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pipeline.errors import PipelineError
from pipeline.rig.camera.camera_files import KeptInMemory, RemoteFile, fetch_files
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import CameraAddress, ControlPatience, FileServer, MirrorSettings
from pipeline.rig.mirror.mirror_controller import open_mirror
from pipeline.rig.rig_check import CheckRow, check_camera, check_mirror
from pipeline.rig.transports import SYSTEM_CLOCK
from tests.faults.fault_table import Clock, Row, reported_wrong
from tests.pipeline.rig.camera.hostile_camera import (
    REPLIES,
    Answers,
    Hostile,
    HostileControl,
    HostileFiles,
    Pieces,
    flood,
    trickled,
)
from tests.pipeline.rig.chaos_line import Mangler
from tests.pipeline.rig.chaotic_surveys import is_message, survey_in_chaos

FULL_S, QUICK_S = 600.0, 6.0  # both devices together
SURVEYS, FEW_SURVEYS = 100, 4
SLACK_S = 1.5  # for threads of a loaded machine
MOST_MEMORY = 200 << 20  # bytes that a process may grow by
PATIENCE = ControlPatience(0.25, 1, 0.01)
ASKED_S = (PATIENCE.retries + 1) * (2 * PATIENCE.deadline_s + PATIENCE.pause_s)
MIRROR = MirrorSettings(deadline_s=0.2, quiet_s=0.02)
MIRROR_S = 24 * (MIRROR.deadline_s + 5 * MIRROR.quiet_s)  # two dozen requests, all of them in vain
SIZE = 1000
TRUE = b'{"success": true, "response": true, "errorMessage": ""}\r\nhpi> '
LISTING = b'{"success": true, "response": [{"name": "/captured/a", "size": 5}], "errorMessage": ""}\r\nhpi> '
SPEAKS = (b"OK\r\n", b"MR-E-2\r\n", b"00000000\r\n", bytes.fromhex("7e00110400000000f2817e"))


@dataclass
class Outcome:
    """What came of many encounters: the longest of each by its deadline, and what was not as it must be."""

    count: int = 0
    slowest: float = 0.0  # fraction of its deadline
    wrong: list[str] = field(default_factory=list)

    def judge(self, name: str, most_s: float, ask: Callable[[], list[str]]) -> None:
        """Run one encounter; it gives messages, and raises nothing else than errors for the user."""
        began = time.monotonic()
        try:
            messages = ask()
        except PipelineError as error:
            messages = [str(error)]
        except Exception as error:
            messages = []
            self.wrong.append(f"{name}: {error!r:.200}")
        took = time.monotonic() - began
        self.count += 1
        self.slowest = max(self.slowest, took / most_s)
        self.wrong += [f"{name}: {took:.1f} s of {most_s:.1f}"] if took > most_s else []
        self.wrong += [f"{name}: no message: {one!r:.200}" for one in messages if not is_message(one)]


def random_pieces(rng: np.random.Generator, valid: bytes, harmless: float = 0.7) -> Pieces:
    """What is said in place of a valid reply."""
    if rng.random() < harmless:
        return [valid]
    cut = int(rng.integers(len(valid))) if valid else 0
    some = rng.bytes(int(rng.integers(1, 200)))
    chosen: list[Pieces] = [
        [Mangler(rng, max(len(valid) / 3, 1.0)).feed(valid)],
        [valid[:cut]],
        [some],
        [9.0],
        [],
        trickled(valid[cut : cut + 1] or b"x"),
        trickled(some),
        flood(valid or b"x"),
        flood(some[:9]),
        [piece for at in range(0, len(valid), 7) for piece in (valid[at : at + 7], 0.01)],
        [valid, some],
        [some, valid],
    ]
    return chosen[int(rng.integers(len(chosen)))]


def meet_camera(rng: np.random.Generator, found: Outcome) -> None:
    """Check a camera, and fetch a file from it."""

    def replies(valid: Pieces) -> Pieces:
        words = b"".join(one for one in valid if isinstance(one, bytes)) if isinstance(valid, list) else b""
        return random_pieces(rng, words, 0.9)

    says = {name: replies(valid) for name, valid in REPLIES.items()}
    says["SIZE"] = random_pieces(rng, f"213 {SIZE}\r\n".encode())
    files = HostileFiles(
        says,
        random_pieces(rng, bytes(SIZE), 0.4),
        greeting=random_pieces(rng, b"220 camera\r\n", 0.8),
        end=random_pieces(rng, b"226 done\r\n", 0.9),
    )
    answers = Answers(
        random_pieces(rng, b"hpi> ", 0.8), {"listFiles": random_pieces(rng, LISTING)}, random_pieces(rng, TRUE)
    )
    with files, HostileControl(answers) as control:
        server = FileServer("127.0.0.1", files.port, stall_s=0.2, tries=2, pause_s=0.0)
        camera = HeadwallCamera.at(CameraAddress("127.0.0.1", control.port), server, patience=PATIENCE)
        kept = KeptInMemory()
        most_s = 2 * ASKED_S + PATIENCE.deadline_s + 3 * server.stall_s + SLACK_S
        found.judge("camera", most_s, lambda: messages(check_camera(lambda: camera)))
        most_s = server.most_s(SIZE) + 4 * server.stall_s + SLACK_S
        file = RemoteFile("/captured/a/raw_0", None, False, most=SIZE)
        found.judge("files", most_s, lambda: fetch_files(server, [file], kept) or [])
        if kept.size(file.name) > SIZE:
            found.wrong.append(f"{kept.size(file.name)} bytes of {SIZE} are kept")


def meet_mirror(rng: np.random.Generator, found: Outcome) -> None:
    """Check a mirror."""
    with HostileMirror(rng) as mirror:
        settings = MirrorSettings(
            f"socket://127.0.0.1:{mirror.port}", deadline_s=MIRROR.deadline_s, quiet_s=MIRROR.quiet_s
        )
        found.judge(
            "mirror", MIRROR_S + SLACK_S, lambda: messages(check_mirror(partial(open_mirror, settings), SYSTEM_CLOCK))
        )


class HostileMirror(Hostile):
    """Says something to whatever comes."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self.rng = rng

    def talk(self, line: socket.socket) -> None:
        """Answer, line by line or frame by frame."""
        self.say(line, random_pieces(self.rng, b"", 0.8))
        for count, _ in enumerate(self.words(line)):
            valid = SPEAKS[0] if count == 0 else SPEAKS[int(self.rng.integers(len(SPEAKS)))]
            self.say(line, random_pieces(self.rng, valid))


def messages(rows: list[CheckRow]) -> list[str]:
    """What a check says of what failed."""
    return [f"{row.asked}: {row.came}; {row.mend}" for row in rows if row.verdict == "fail"]


def meet_for(seconds: float, seed: int, meet: Callable[[np.random.Generator, Outcome], None]) -> Outcome:
    """Encounters one after the other for so long."""
    found, rng, until = Outcome(), np.random.default_rng(seed), time.monotonic() + seconds
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with _quiet():
        while time.monotonic() < until:
            meet(rng, found)
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    if grown > MOST_MEMORY:
        found.wrong.append(f"the process grew by {grown >> 20} MB")
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def rows(quick: bool = False) -> list[Row]:
    seconds = (QUICK_S if quick else FULL_S) / 2
    demanded = "each done by its deadline, in one message and bounded memory"
    injected = "random replies: torn, mangled, trickled, endless, none"
    found = []
    for name, meet in {"hostile camera": meet_camera, "hostile mirror": meet_mirror}.items():
        clock, one = Clock(), meet_for(seconds, 20, meet)
        told = f"the slowest took {one.slowest:.0%} of its deadline; {reported_wrong(one.wrong)}"
        found.append(Row(name, injected, one.count, demanded, told, not one.wrong, clock.seconds))
    clock = Clock()
    with _quiet():
        chaos = survey_in_chaos(range(2000, 2000 + (FEW_SURVEYS if quick else SURVEYS)))
    told = f"{chaos.told} told; {chaos.strikes} strikes; {reported_wrong(chaos.wrong)}"
    injected = "bytes put in, doubled and cut out, control, FTP and its transfers, both ways"
    demanded = "bytes of the undisturbed survey or one message; the rerun gives them all"
    row = Row("line of the camera", injected, chaos.surveys, demanded, told, not chaos.wrong, clock.seconds)
    return [*found, row]
