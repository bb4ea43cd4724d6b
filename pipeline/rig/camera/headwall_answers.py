"""What the camera's replies say: whether they belong to a command, refusals in words that help, and their responses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pipeline.errors import RigError
from pipeline.rig.camera.headwall_replies import Said
from pipeline.rig.camera.kept_files import RemoteFile, check_remote_name
from pipeline.rig.device_errors import DeviceRefused

# words of a refusal -> what to do about it
_REMEDIES = (
    (("full", "space", "storage"), "copy the folders on the camera's disk to another and delete them there"),
    (
        ("busy", "already", "progress", "in use"),
        "wait until it is done, or stop it with its own program; run again",
    ),
    (("exposure", "period"), "give an exposure that is not longer than the frame period, both in ms"),
    (("folder", "directory", "file", "path"), "list the folder above it and take a name from there"),
)


_UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
_LONGEST_REASON = 300
TIMES_ALIKE = 0.01  # of a time: cameras round them to what their clock gives


class MisfitError(Exception):
    """A response that is no answer to this command."""


def other_command(said: Said, name: str) -> str:
    """Why this is no reply to the command; empty where it may be one."""
    return f"a reply to {said.command}" if said.command not in ("", name) else ""


def check_repeated(said: Said, sent: str, port: str) -> None:
    """Refuse a reply to other words than were sent: they, or those that came back, were damaged on their way.

    Raises
    ------
    RigError : the camera repeats a command with its argument, and it is another one.
    """
    if "(" in said.echo and said.echo.split() != sent.split():
        raise RigError(
            f"{port} took {said.echo[:200]!r}, sent was {sent[:200]!r}; look at the network between here and the camera"
        )


def response_of(said: Said, name: str, port: str) -> Any:
    """The response of a reply that says success.

    Raises
    ------
    DeviceRefused : the reply says no; the message says what to do. RigError : it is no reply.
    """
    if said.reply is None:
        raise RigError(
            f"{port} answered {name} with {said.text[:200]!r}, expected JSON; is this the camera's control port?"
        )
    success = said.reply.get("success")
    if not isinstance(success, bool):
        raise RigError(f"{port} answered {name} with {said.text[:200]!r}, expected success true or false")
    if not success:
        words = _UNFIT.sub("?", str(said.reply.get("errorMessage") or "no reason given"))[:_LONGEST_REASON]
        lower = words.lower()
        remedy = next(
            (what for keys, what in _REMEDIES if any(key in lower for key in keys)), "see the camera's manual"
        )
        raise DeviceRefused(f"the camera at {port} refused {name}: {words}; {remedy}")
    return said.reply.get("response")


def as_folder(response: Any) -> str:
    """The folder of a capture.

    Raises
    ------
    MisfitError : this answers another command.
    """
    folder = response.get("folder") if isinstance(response, dict) else None
    if not isinstance(folder, str) or not folder:
        raise MisfitError("a reply without a folder")
    check_remote_name(folder)
    return folder


def check_times_set(response: Any, asked_ms: Mapping[str, float]) -> None:
    """Compare the times that were set, as far as the response tells them, with those that were asked for. [ms]

    Raises
    ------
    RigError : another time was set.
    """
    told = response if isinstance(response, dict) else {}
    for name, wanted in asked_ms.items():
        found = told.get(name, wanted)
        if not isinstance(found, int | float) or not abs(found - wanted) <= TIMES_ALIKE * wanted:
            raise RigError(
                f"the camera set {name} to {found!r:.40} ms, asked was {wanted:g} ms; give a time that it takes"
            )


def as_truth(response: Any) -> bool:
    """Whether it captures.

    Raises
    ------
    MisfitError : this answers another command.
    """
    value = response.get("capturing") if isinstance(response, dict) else response
    if not isinstance(value, bool):
        raise MisfitError("a reply that is neither true nor false")
    return value


def as_stopped(response: Any) -> bool:
    """Whether something was stopped; success alone counts as that."""
    return response if isinstance(response, bool) else True


def as_listing(response: Any) -> list[RemoteFile]:
    """Entries of a folder, by name.

    Raises
    ------
    MisfitError : this answers another command. RigError : a name cannot be asked for.
    """
    if not isinstance(response, list):
        raise MisfitError("a reply that is no list")
    found = []
    for entry in response:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            raise MisfitError("a list of something else than files")
        check_remote_name(name)
        found.append(RemoteFile(re.sub("/{2,}", "/", name), _size(entry.get("size")), bool(entry.get("isDirectory"))))
    return sorted(found, key=lambda entry: entry.name)


def _size(value: Any) -> int | None:
    try:
        return max(int(value), 0)
    except (TypeError, ValueError, OverflowError):
        return None
