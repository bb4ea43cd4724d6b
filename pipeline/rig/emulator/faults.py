"""The faults that the emulated controller has on request, by name. What they do is declared here, each in one line."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial

from pipeline.errors import SettingsError
from pipeline.rig.emulator import device_faults as device
from pipeline.rig.emulator import wire_faults as wire
from pipeline.rig.emulator.fault import Chance, Fault, FaultKind, Where
from pipeline.rig.mirror.pro_mode import Command, ErrorCode, error_words
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.simple_mode import Answer

__all__ = ["KINDS", "Chance", "Fault", "FaultKind", "Where", "make_fault", "read_fault"]

_BYTES = 1024  # within so many bytes to the controller
_FEW = 6  # opportunities of faults that only strike lines of simple mode
_VALUES = frozenset({Command.GET_VALUE, Command.SET_VALUE, Command.GET_VALUES, Command.SET_VALUES})
_SETTING = frozenset({Command.SET_VALUE, Command.SET_VALUES})
_VECTORS = frozenset({Command.SET_VECTOR, Command.GET_VECTOR})
_UPLOAD = frozenset({Command.SET_VECTOR})


def _line(name: str, answer: Answer, words: str) -> FaultKind:
    return FaultKind(name, words, Where.ANSWER, partial(device.AnswersLine, answer=answer), _FEW)


def _code(name: str, code: int, commands: Collection[int] | None, span: int = 64) -> FaultKind:
    words = f"one frame is refused: {error_words(code)}"
    return FaultKind(name, words, Where.ANSWER, partial(device.AnswersError, code=code, commands=commands), span)


def _bit(name: str, bit: Status, words: str) -> FaultKind:
    return FaultKind(name, words, Where.STATE, partial(device.StatusBit, bit=bit), 32)


_OF_BYTES = (
    FaultKind(
        "request-byte-lost", "one byte to the controller is lost",
        Where.REQUEST, partial(wire.RequestByte, change=wire.lose), _BYTES,
    ),
    FaultKind(
        "request-bit-flipped", "one bit of one byte to the controller is turned",
        Where.REQUEST, partial(wire.RequestByte, change=wire.flip), _BYTES,
    ),
    FaultKind(
        "request-byte-doubled", "one byte to the controller comes twice",
        Where.REQUEST, partial(wire.RequestByte, change=wire.double), _BYTES,
    ),
    FaultKind(
        "reply-byte-lost", "one byte of one reply is lost", Where.REPLY, partial(wire.ReplyByte, change=wire.lose)
    ),
    FaultKind(
        "reply-bit-flipped", "one bit of one reply is turned", Where.REPLY, partial(wire.ReplyByte, change=wire.flip)
    ),
    FaultKind(
        "reply-byte-doubled", "one byte of one reply comes twice",
        Where.REPLY, partial(wire.ReplyByte, change=wire.double),
    ),
    FaultKind("split-replies", "replies come in pieces", Where.REPLY, wire.SplitReplies, harmless=True),
    FaultKind("merged-replies", "replies wait for each other", Where.REPLY, wire.MergedReplies, harmless=True),
    FaultKind(
        "stale-bytes", "the port holds what another program asked for", Where.REPLY, wire.StaleBytes, harmless=True
    ),
    FaultKind("noise", "bytes that mean nothing come before one reply", Where.REPLY, wire.Noise),
    FaultKind("old-reply-again", "the reply before comes once more, before one", Where.REPLY, device.OldReplyAgain),
    FaultKind("late-reply", "one reply comes long after any deadline", Where.REPLY, wire.LateReply),
    FaultKind("just-late-reply", "one reply comes around its deadline", Where.REPLY, wire.JustLateReply),
    FaultKind("no-reply", "one request is carried out and never answered", Where.REPLY, wire.LostReply),
    FaultKind("mute", "from some request on nothing is answered", Where.REPLY, wire.Mute),
    FaultKind("slow-bytes", "bytes of replies come one at a time, 20 ms apart", Where.REPLY, wire.SlowBytes),
)  # fmt: skip

_OF_ANSWERS = (
    _line("answers-no", Answer.NO, "one line of simple mode is answered by NO"),
    _line("answers-ol", Answer.BELOW, "one line of simple mode is answered by OL, below the range"),
    _line("answers-ou", Answer.ABOVE, "one line of simple mode is answered by OU, above the range"),
    _line("answers-error", Answer.ERROR, "one line of simple mode is answered by ERROR"),
    _code("error-frame", ErrorCode.FRAME_INVALID, None),
    _code("error-length", ErrorCode.LENGTH_MISMATCH, None),
    _code("error-crc", ErrorCode.CRC_WRONG, None),
    _code("error-no-register", ErrorCode.NO_REGISTER, _VALUES, 8),
    _code("error-range", ErrorCode.OUT_OF_RANGE, _SETTING, 4),
    _code("error-read-only", ErrorCode.READ_ONLY, _SETTING, 4),
    _code("error-vector-index", ErrorCode.VECTOR_INDEX, _VECTORS),
    _code("error-chain", ErrorCode.CHAIN, _SETTING, 4),
    _code("error-unknown", 0xBEEF, None),
    FaultKind(
        "wrong-firmware", "the controller says that it is another model", Where.ANSWER, device.OtherFirmware
    ),
    FaultKind("cell-lost", "one cell is acknowledged and not written", Where.STATE, device.CellLost, 16),
)  # fmt: skip

_OF_STATE = (
    FaultKind("pro-at-connect", "the controller was left in pro mode", Where.STATE, device.ProAtConnect, harmless=True),
    FaultKind(
        "silent-reset", "the controller restarts unasked and says nothing",
        Where.STATE, partial(device.SilentReset, boot_s=0.0),
    ),
    FaultKind(
        "reset-in-upload", "the controller restarts while its vector memory is written",
        Where.STATE, partial(device.SilentReset, boot_s=1.0, commands=_UPLOAD), 16,
    ),
    _bit("never-stable", Status.NOT_STABLE, "the mirror never comes to rest, by its status"),
    _bit("trimmed", Status.TRIMMED, "the status says that a target was trimmed"),
    _bit("mirror-warm", Status.MIRROR_WARM, "the mirror is too warm"),
    _bit("electronics-warm", Status.ELECTRONICS_WARM, "the mirror head's electronics are too warm"),
    _bit("disconnected", Status.DISCONNECTED, "the mirror head is not connected"),
    _bit("eeprom-invalid", Status.EEPROM_INVALID, "the mirror's own calibration cannot be read"),
)  # fmt: skip

_OF_PORTS = (
    FaultKind("gone-before", "the device goes away before a request", Where.PORT, wire.GoneBefore),
    FaultKind("gone-within", "the device goes away in the middle of a request", Where.PORT, wire.GoneWithin, _BYTES),
    FaultKind("gone-after", "the device carries a request out and goes away", Where.PORT, wire.GoneAfter),
    FaultKind("hangs", "from some request on the port takes no bytes", Where.PORT, wire.PortHangs),
    FaultKind("echo", "a loop of wire is connected instead of the controller", Where.PORT, wire.Echo),
    FaultKind("modem", "a modem is connected instead of the controller", Where.PORT, wire.Modem),
)

KINDS = {kind.name: kind for kind in (*_OF_BYTES, *_OF_ANSWERS, *_OF_STATE, *_OF_PORTS)}


def make_fault(name: str, seed: int = 0, at: int | None = None) -> Fault:
    """Build a fault of a kind; the seed says when it strikes and how, ``at`` says at which opportunity instead.

    Raises
    ------
    SettingsError : no such kind, or an opportunity below 0.
    """
    if name not in KINDS:
        raise SettingsError(f"there is no fault {name!r}; there are {', '.join(sorted(KINDS))}")
    if at is not None and at < 0:
        raise SettingsError(f"fault {name} strikes at opportunity 0 or later, got {at}")
    return KINDS[name].make(seed, at)


def read_fault(text: str) -> Fault:
    """Build a fault from ``name`` or ``name:seed``, as users write it.

    Raises
    ------
    SettingsError : no such kind, or a seed that is no whole number.
    """
    name, _, seed = text.partition(":")
    if seed and not seed.lstrip("-").isdecimal():
        raise SettingsError(f"expected a fault as name or name:seed with a whole number, got {text!r}")
    return make_fault(name, int(seed or 0))
