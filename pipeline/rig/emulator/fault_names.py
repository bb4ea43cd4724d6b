"""Faults of both emulated devices by the names that users give: ``name`` or ``name:seed``, with commas."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from pipeline.errors import SettingsError
from pipeline.rig.emulator.camera_faults import CameraFault, CameraFaults
from pipeline.rig.emulator.fault import Fault
from pipeline.rig.emulator.faults import KINDS, read_fault

CAMERA_WORDS = {
    CameraFault.SLOW: "a reply comes late, and in time",
    CameraFault.LATE: "a reply comes after any deadline",
    CameraFault.SILENT: "a command is done and its reply is lost",
    CameraFault.SPLIT: "a reply comes in pieces",
    CameraFault.MERGED: "a reply comes together with one to a command that nobody sent",
    CameraFault.STALE: "a reply to another command comes before the right one",
    CameraFault.NOT_JSON: "a reply is no JSON",
    CameraFault.HANGS_UP: "a command is done, and the connection closed without a reply",
    CameraFault.FULL: "a capture is refused: the disk is full",
    CameraFault.BUSY: "a capture is refused: the camera is busy",
    CameraFault.CUT_CUBE: "a cube ends within a line",
    CameraFault.BREAKS_OFF: "a transfer of a file is closed half way",
    CameraFault.REFUSES_FILES: "a connection for files is closed at once",
}
_CAMERA = {"camera-" + fault.value.lower().replace(" ", "-"): fault for fault in CameraFault}
_CAMERA["camera-cut-cube"] = _CAMERA.pop("camera-cut-off-in-a-cube")


def fault_table() -> list[tuple[str, str, str]]:
    """Give every fault as its name, what it strikes, and what happens."""
    mirror = [(kind.name, f"mirror: {kind.where.value}", kind.words) for kind in KINDS.values()]
    return mirror + [(name, "camera", CAMERA_WORDS[fault]) for name, fault in _CAMERA.items()]


def read_faults(words: Sequence[str]) -> tuple[list[Fault], CameraFaults]:
    """Build faults of the mirror and of the camera. The seed says when and how one of the mirror strikes.

    A fault of the camera strikes once, at its first occasion; given with several seeds, so often. The seeds say how.

    Raises
    ------
    SettingsError : no such fault, or a seed that is no whole number.
    """
    mirror: list[Fault] = []
    camera: dict[CameraFault, int] = {}
    seeds = 0
    for word in words:
        name, _, seed = word.partition(":")
        if name in _CAMERA:
            camera[_CAMERA[name]] = camera.get(_CAMERA[name], 0) + 1
            seeds += _whole(seed or "0", word)
        elif name in KINDS:
            mirror.append(read_fault(word))
        else:
            near = get_close_matches(name, [*KINDS, *_CAMERA], 1)
            hint = f"did you mean {near[0]}?" if near else "rig emulate --faults list shows all"
            raise SettingsError(f"there is no fault {name!r}; {hint}")
    return mirror, CameraFaults.of(camera, seeds)


def _whole(seed: str, word: str) -> int:
    if not seed.isdecimal():
        raise SettingsError(f"expected a fault as name or name:seed with a whole number from 0 on, got {word!r}")
    return int(seed)
