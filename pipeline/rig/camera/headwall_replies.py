"""Text of the camera's control socket: commands as lines, replies as JSON between prompts, and what replies say.

A command is ``name`` or ``name(JSON)`` and a carriage return. The camera repeats that line (some versions do not),
then come ``{"success": ..., "response": ..., "errorMessage": ...}`` and the prompt ``hpi> ``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import RemoteFile, check_remote_name
from pipeline.rig.transports import DeviceRefused

PROMPT = b"hpi> "
COMMANDS = ("configure", "capture", "isCapturing", "stopCapture", "listFiles", "exit")
LONGEST_REPLY = 1 << 24  # bytes: a listing of a hundred thousand files
MOST_PROMPTS = 16  # in the texts of one reply

# a telnet server's negotiations; JSON in UTF-8 never holds the byte FF
_NEGOTIATION = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)
# words of a refusal -> what to do about it
_REMEDIES = (
    (("full", "space", "storage"), "copy the folders on the camera's disk to another and delete them there"),
    (("busy", "already", "progress", "in use"), "wait until it is done, or stop it with its own program; run again"),
    (("exposure", "period"), "give an exposure that is not longer than the frame period, both in ms"),
    (("folder", "directory", "file", "path"), "list the folder above it and take a name from there"),
)
_UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
_LONGEST_REASON = 300
TIMES_ALIKE = 0.01  # of a time: cameras round them to what their clock gives


@dataclass(frozen=True)
class Said:
    """Text before one prompt: the command it repeats, if any, and the reply, if it is one."""

    echo: str
    reply: dict[str, Any] | None
    text: str  # as it came, for messages

    @property
    def command(self) -> str:
        """The command that was repeated; empty where none was."""
        name = self.echo.split("(")[0].strip()
        return name if name in COMMANDS else ""


class MisfitError(Exception):
    """A response that is no answer to this command."""


def to_request(name: str, argument: Any = None) -> bytes:
    """Write a command as the camera takes it."""
    text = name if argument is None else f"{name}({json.dumps(argument)})"
    return text.encode("ascii") + b"\r"


class ReplyReader:
    """Takes bytes as they come and gives what stands before each prompt, once the prompt is whole.

    Each byte is looked at a bounded number of times, however few come at once and whatever they are.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._searched = 0  # bytes in which no prompt begins that ends a reply
        self._passed = 0  # prompts among them

    @property
    def held(self) -> bytes:
        """Bytes that no prompt has followed yet."""
        return bytes(self._held)

    def feed(self, data: bytes) -> list[Said]:
        """Take bytes; give what is complete, which may be nothing or several replies.

        RigError where more came without a prompt than any reply has.
        """
        cut = max(len(self._held) - 2, 0)  # a negotiation may have come in part
        self._held[cut:] = _NEGOTIATION.sub(b"", bytes(self._held[cut:]) + data)
        said: list[Said] = []
        while (end := self._prompt_at()) >= 0:
            said += _parse(bytes(self._held[:end]))
            del self._held[: end + len(PROMPT)]
            self._searched = self._passed = 0
        if len(self._held) > LONGEST_REPLY:
            raise RigError(f"{len(self._held)} bytes came without a prompt 'hpi> '; is this the camera's control port?")
        return said

    def _prompt_at(self) -> int:
        """Return the place of the first prompt: at a line's start, or right behind a reply (a reply may hold one)."""
        while (at := self._held.find(PROMPT, self._searched)) >= 0:
            if at == 0 or self._held[at - 1] in b"\r\n":
                return at
            if any(said.reply is not None for said in _parse(bytes(self._held[:at]))):
                return at
            self._searched, self._passed = at + 1, self._passed + 1
            if self._passed > MOST_PROMPTS:
                raise RigError(
                    f"{self._passed} prompts 'hpi> ' came within one reply, {self.held[:80]!r} and on; is this the "
                    "camera's control port?"
                )
        self._searched = max(len(self._held) - len(PROMPT) + 1, self._searched)
        return -1


def _parse(data: bytes) -> list[Said]:
    """Return the replies in the text before a prompt: mostly one; none in a greeting or an empty line."""
    text = data.decode("utf-8", errors="replace").strip("\0 \t\r\n")
    if not text:
        return []
    echo, body = "", text
    if not text.startswith("{"):
        parts = re.split(r"[\r\n]+", text, maxsplit=1)
        echo, body = parts[0].strip(), parts[1].strip("\0 \t\r\n") if len(parts) > 1 else ""
    found: list[Said] = []
    while body.startswith("{"):
        try:
            value, end = json.JSONDecoder().raw_decode(body)
        except (ValueError, RecursionError):
            break
        found.append(Said(echo, value, text))
        echo, body = "", body[end:].strip("\0 \t\r\n")
    return found if found and not body else [*found, Said(echo, None, text)]


def check_repeated(said: Said, sent: str, port: str) -> None:
    """Refuse a reply to other words than were sent (RigError): they, or those that came back, were damaged."""
    if "(" in said.echo and said.echo.split() != sent.split():
        raise RigError(
            f"{port} took {said.echo[:200]!r}, sent was {sent[:200]!r}; look at the network between here and the camera"
        )


def response_of(said: Said, name: str, port: str) -> Any:
    """Return the response of a reply that reports success.

    Raises DeviceRefused, with the remedy: it reports a failure. Raises RigError: there is none.
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
    """Return the folder of a capture. Raises MisfitError: the response answers another command."""
    folder = response.get("folder") if isinstance(response, dict) else None
    if not isinstance(folder, str) or not folder:
        raise MisfitError("a reply without a folder")
    check_remote_name(folder)
    return folder


def check_times_set(response: Any, asked_ms: Mapping[str, float]) -> None:
    """Refuse other times [ms] than were asked for, as far as the response tells what was set (RigError)."""
    told = response if isinstance(response, dict) else {}
    for name, wanted in asked_ms.items():
        found = told.get(name, wanted)
        if not isinstance(found, int | float) or not abs(found - wanted) <= TIMES_ALIKE * wanted:
            raise RigError(
                f"the camera set {name} to {found!r:.40} ms, asked was {wanted:g} ms; give a time that it takes"
            )


def as_truth(response: Any) -> bool:
    """Return whether it captures; MisfitError where this answers another command."""
    value = response.get("capturing") if isinstance(response, dict) else response
    if not isinstance(value, bool):
        raise MisfitError("a reply that is neither true nor false")
    return value


def as_listing(response: Any) -> list[RemoteFile]:
    """Return the entries of a folder, by name.

    Raises MisfitError: the response answers another command. Raises RigError: a name cannot be used.
    """
    if not isinstance(response, list):
        raise MisfitError("a reply that is no list")
    found = []
    for entry in response:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            raise MisfitError("a list of something else than files")
        check_remote_name(name)
        try:
            size = max(int(entry.get("size")), 0)
        except (TypeError, ValueError, OverflowError):
            size = None
        found.append(RemoteFile(re.sub("/{2,}", "/", name), size, bool(entry.get("isDirectory"))))
    return sorted(found, key=lambda entry: entry.name)
