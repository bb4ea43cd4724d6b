"""Faults of both emulated devices by the names that users give: ``name`` or ``name:seed``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from enum import Enum
from functools import partial

import numpy as np

from pipeline.errors import SettingsError
from pipeline.rig.emulator import mirror_faults as mirror
from pipeline.rig.emulator.mirror_device import Chance, Fault
from pipeline.rig.mirror.mirror_requests import Reply
from pipeline.rig.mirror.pro_mode import Command, ErrorCode, error_words
from pipeline.rig.mirror.registers import Status

_BYTES = 1024  # within so many bytes to the controller
_FEW = 6  # opportunities of faults that only strike lines of simple mode
# what faults of the mirror strike
_REQUEST = "bytes to the controller"
_REPLY = "bytes from the controller"
_ANSWER = "what the controller answers"
_STATE = "what the controller is in"
_PORT = "the port"
_VALUES = frozenset({Command.GET_VALUE, Command.SET_VALUE, Command.GET_VALUES, Command.SET_VALUES})
_SETTING = frozenset({Command.SET_VALUE, Command.SET_VALUES})
_VECTORS = frozenset({Command.SET_VECTOR, Command.GET_VECTOR})
_UPLOAD = frozenset({Command.SET_VECTOR})


class CameraFault(Enum):
    """A fault of the camera, and what happens where it strikes."""

    words: str

    SLOW = "slow", "a reply comes late, and in time"
    LATE = "late", "a reply comes after any deadline"
    SILENT = "silent", "a command is done and its reply is lost"
    SPLIT = "split", "a reply comes in pieces"
    MERGED = "merged", "a reply comes together with one to a command that nobody sent"
    STALE = "stale", "a reply to another command comes before the right one"
    NOT_JSON = "not-json", "a reply is no JSON"
    HANGS_UP = "hangs-up", "a command is done, and the connection closed without a reply"
    FULL = "full", "a capture is refused: the disk is full"
    BUSY = "busy", "a capture is refused: the camera is busy"
    CUT_CUBE = "cut-cube", "a cube ends within a line"
    BREAKS_OFF = "breaks-off", "a transfer of a file is closed half way"
    REFUSES_FILES = "refuses-files", "a connection for files is closed at once"

    def __new__(cls, name: str, words: str) -> CameraFault:
        fault = object.__new__(cls)
        fault._value_, fault.words = name, words
        return fault


@dataclass
class CameraFaults:
    """Faults still to come, each so many times, after ``passes`` occasions; where pieces are cut is by the seed."""

    left: dict[CameraFault, int] = field(default_factory=dict)
    seed: int = 0
    passes: int = 0
    slow_s: float = 1.0
    late_s: float = 60.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def strikes(self, fault: CameraFault) -> bool:
        """Whether the fault strikes now; it is then one less to come."""
        if self.left.get(fault, 0) < 1:
            return False
        if self.passes > 0:
            self.passes -= 1
            return False
        self.left[fault] -= 1
        return True


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault of the mirror that users can ask for by its name.

    ``span`` is the number of opportunities within which it strikes; ``harmless`` ones change nothing that a driver of
    this protocol may not cope with.
    """

    name: str
    words: str
    where: str
    build: Callable[[Chance], Fault]
    span: int = 64
    harmless: bool = False


def _request(name: str, words: str, change: mirror.Change) -> FaultKind:
    return FaultKind(name, words, _REQUEST, partial(mirror.RequestByte, change=change), _BYTES)


def _reply(name: str, words: str, spoil: mirror.Spoil, *, lasting: bool = False, harmless: bool = False) -> FaultKind:
    build = partial(mirror.SpoiltReply, spoil=spoil, lasting=lasting)
    return FaultKind(name, words, _REPLY, build, harmless=harmless)


def _line(name: str, answer: Reply, words: str) -> FaultKind:
    words = f"one line of simple mode is answered by {answer}{words}"
    return FaultKind(name, words, _ANSWER, partial(mirror.AnswersLine, answer=answer), _FEW)


def _code(name: str, code: int, commands: Collection[int] | None = None, span: int = 64) -> FaultKind:
    words = f"one frame is refused: {error_words(code)}"
    return FaultKind(name, words, _ANSWER, partial(mirror.AnswersError, code=code, commands=commands), span)


def _bit(name: str, bit: Status, words: str) -> FaultKind:
    return FaultKind(name, words, _STATE, partial(mirror.StatusBit, bit=bit), 32)


_KINDS = (
    _request("request-byte-lost", "one byte to the controller is lost", mirror.lose),
    _request("request-bit-flipped", "one bit of one byte to the controller is turned", mirror.flip),
    _request("request-byte-doubled", "one byte to the controller comes twice", mirror.double),
    _reply("reply-byte-lost", "one byte of one reply is lost", mirror.changed(mirror.lose)),
    _reply("reply-bit-flipped", "one bit of one reply is turned", mirror.changed(mirror.flip)),
    _reply("reply-byte-doubled", "one byte of one reply comes twice", mirror.changed(mirror.double)),
    _reply("split-replies", "replies come in pieces", mirror.split, lasting=True, harmless=True),
    _reply("merged-replies", "replies wait for each other", mirror.merge, lasting=True, harmless=True),
    FaultKind("stale-bytes", "the port holds what another program asked for", _REPLY, mirror.StaleBytes, harmless=True),
    _reply("noise", "bytes that mean nothing come before one reply", mirror.noise),
    FaultKind("old-reply-again", "the reply before comes once more, before one", _REPLY, mirror.OldReplyAgain),
    _reply("late-reply", "one reply comes long after any deadline", mirror.late),
    _reply("just-late-reply", "one reply comes around its deadline", mirror.just_late),
    _reply("no-reply", "one request is carried out and never answered", mirror.lost),
    _reply("mute", "from some request on nothing is answered", mirror.lost, lasting=True),
    _reply("slow-bytes", "bytes of replies come one at a time, 20 ms apart", mirror.slow, lasting=True),
    _line("answers-no", Reply.NO, ""),
    _line("answers-ol", Reply.BELOW, ", below the range"),
    _line("answers-ou", Reply.ABOVE, ", above the range"),
    _line("answers-error", Reply.ERROR, ""),
    _code("error-frame", ErrorCode.FRAME_INVALID),
    _code("error-length", ErrorCode.LENGTH_MISMATCH),
    _code("error-crc", ErrorCode.CRC_WRONG),
    _code("error-no-register", ErrorCode.NO_REGISTER, _VALUES, 8),
    _code("error-range", ErrorCode.OUT_OF_RANGE, _SETTING, 4),
    _code("error-read-only", ErrorCode.READ_ONLY, _SETTING, 4),
    _code("error-vector-index", ErrorCode.VECTOR_INDEX, _VECTORS),
    _code("error-chain", ErrorCode.CHAIN, _SETTING, 4),
    _code("error-unknown", 0xBEEF),
    FaultKind("wrong-firmware", "the controller says that it is another model", _ANSWER, mirror.OtherFirmware),
    FaultKind("cell-lost", "one cell is acknowledged and not written", _STATE, mirror.CellLost, 16),
    FaultKind("pro-at-connect", "the controller was left in pro mode", _STATE, mirror.ProAtConnect, harmless=True),
    FaultKind(
        "silent-reset",
        "the controller restarts unasked and says nothing",
        _STATE,
        partial(mirror.SilentReset, boot_s=0.0),
    ),
    FaultKind(
        "reset-in-upload",
        "the controller restarts while its vector memory is written",
        _STATE,
        partial(mirror.SilentReset, boot_s=1.0, commands=_UPLOAD),
        16,
    ),
    _bit("never-stable", Status.NOT_STABLE, "the mirror never comes to rest, by its status"),
    _bit("trimmed", Status.TRIMMED, "the status says that a target was trimmed"),
    _bit("mirror-warm", Status.MIRROR_WARM, "the mirror is too warm"),
    _bit("electronics-warm", Status.ELECTRONICS_WARM, "the mirror head's electronics are too warm"),
    _bit("disconnected", Status.DISCONNECTED, "the mirror head is not connected"),
    _bit("eeprom-invalid", Status.EEPROM_INVALID, "the mirror's own calibration cannot be read"),
    FaultKind("gone-before", "the device goes away before a request", _PORT, mirror.GoneBefore),
    FaultKind("gone-within", "the device goes away in the middle of a request", _PORT, mirror.GoneWithin, _BYTES),
    FaultKind("gone-after", "the device carries a request out and goes away", _PORT, mirror.GoneAfter),
    FaultKind("hangs", "from some request on the port takes no bytes", _PORT, mirror.PortHangs),
    FaultKind("echo", "a loop of wire is connected instead of the controller", _PORT, mirror.Echo),
    FaultKind("modem", "a modem is connected instead of the controller", _PORT, mirror.Modem),
)
KINDS = {kind.name: kind for kind in _KINDS}
_CAMERA = {"camera-" + fault.value.lower().replace(" ", "-"): fault for fault in CameraFault}


def fault_table() -> list[tuple[str, str, str]]:
    """Give every fault as its name, what it strikes, and what happens."""
    rows = [(kind.name, f"mirror: {kind.where}", kind.words) for kind in KINDS.values()]
    return rows + [(name, "camera", fault.words) for name, fault in _CAMERA.items()]


def make_fault(name: str, seed: int = 0, at: int | None = None) -> Fault:
    """Build a fault of the mirror (SettingsError: there is none); the seed says when and how, ``at`` when instead."""
    if name not in KINDS:
        raise SettingsError(f"there is no fault {name!r}; there are {', '.join(sorted(KINDS))}")
    if at is not None and at < 0:
        raise SettingsError(f"fault {name} strikes at opportunity 0 or later, got {at}")
    return KINDS[name].build(Chance.drawn(name, seed, KINDS[name].span, at))


def read_fault(text: str) -> Fault:
    """Build a fault of the mirror from ``name`` or ``name:seed`` (SettingsError: it is neither)."""
    name, _, seed = text.partition(":")
    if seed and not seed.lstrip("-").isdecimal():
        raise SettingsError(f"expected a fault as name or name:seed with a whole number, got {text!r}")
    return make_fault(name, int(seed or 0))


def read_faults(words: Sequence[str]) -> tuple[list[Fault], CameraFaults]:
    """Build faults of the mirror and of the camera; SettingsError for a name that is none, or a seed.

    The seed says when and how one of the mirror strikes. A fault of the camera strikes once, at its first occasion;
    given with several seeds, so often. The seeds say how.
    """
    of_mirror: list[Fault] = []
    of_camera: dict[CameraFault, int] = {}
    seeds = 0
    for word in words:
        name, _, seed = word.partition(":")
        if name in _CAMERA:
            if seed and not seed.isdecimal():
                raise SettingsError(
                    f"expected a fault as name or name:seed with a whole number from 0 on, got {word!r}"
                )
            of_camera[_CAMERA[name]] = of_camera.get(_CAMERA[name], 0) + 1
            seeds += int(seed or 0)
        elif name in KINDS:
            of_mirror.append(read_fault(word))
        else:
            near = get_close_matches(name, [*KINDS, *_CAMERA], 1)
            hint = f"did you mean {near[0]}?" if near else "rig emulate --faults list shows all"
            raise SettingsError(f"there is no fault {name!r}; {hint}")
    return of_mirror, CameraFaults(of_camera, seeds)
