"""Text of the camera's control socket: commands as lines, replies as JSON between prompts, however they are cut.

A command is ``name`` or ``name(JSON)`` and a carriage return. The camera repeats that line (some versions do not),
then come ``{"success": ..., "response": ..., "errorMessage": ...}`` and the prompt ``hpi> ``.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

from pipeline.errors import RigError

PROMPT = b"hpi> "
COMMANDS = ("configure", "capture", "isCapturing", "stopCapture", "listFiles", "exit")
LONGEST_REPLY = 1 << 24  # bytes: a listing of a hundred thousand files

# a telnet server's negotiations; JSON in UTF-8 never holds the byte FF
_NEGOTIATION = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)
_AT_LINE_START = re.compile(rb"(?:^|[\r\n])" + re.escape(PROMPT))


@dataclass(frozen=True)
class Said:
    """What came before one prompt: the command it repeats, if any, and the reply, if it is one."""

    echo: str
    reply: dict[str, Any] | None
    text: str  # as it came, for messages

    @property
    def command(self) -> str:
        """The command that was repeated; empty where none was."""
        name = self.echo.split("(")[0].strip()
        return name if name in COMMANDS else ""


def to_request(name: str, argument: Any = None) -> bytes:
    """Write a command as the camera takes it."""
    text = name if argument is None else f"{name}({json.dumps(argument)})"
    return text.encode("ascii") + b"\r"


class ReplyReader:
    """Takes bytes as they come and gives what stands before each prompt, once the prompt is whole."""

    def __init__(self) -> None:
        self._held = b""

    @property
    def held(self) -> bytes:
        """Bytes that no prompt has followed yet."""
        return self._held

    def feed(self, data: bytes) -> list[Said]:
        """Take bytes; give what is complete, which may be nothing or several replies.

        Raises
        ------
        RigError : more came without a prompt than any reply has.
        """
        self._held = _NEGOTIATION.sub(b"", self._held + data)
        said: list[Said] = []
        while (end := self._prompt_at()) >= 0:
            before, self._held = self._held[:end], self._held[end + len(PROMPT) :]
            said += _parse(before)
        if len(self._held) > LONGEST_REPLY:
            raise RigError(f"{len(self._held)} bytes came without a prompt 'hpi> '; is this the camera's control port?")
        return said

    def _prompt_at(self) -> int:
        """Where the first prompt is: at a line's start, or right behind a reply (a text in a reply may hold one)."""
        match = _AT_LINE_START.search(self._held)
        first = -1 if match is None else match.end() - len(PROMPT)
        at = self._held.find(PROMPT)
        while 0 <= at != first:
            if any(said.reply is not None for said in _parse(self._held[:at])):
                return at
            at = self._held.find(PROMPT, at + 1)
        return first


def _parse(data: bytes) -> list[Said]:
    """Replies in the text before a prompt: mostly one; none in a greeting or an empty line."""
    text = data.decode("utf-8", errors="replace").strip("\0 \t\r\n")
    if not text:
        return []
    echo, body = ("", text) if text.startswith("{") else _first_line(text)
    found: list[Said] = []
    while body.startswith("{"):
        try:
            value, end = json.JSONDecoder().raw_decode(body)
        except (ValueError, RecursionError):
            break
        found.append(Said(echo, value, text))
        echo, body = "", body[end:].strip("\0 \t\r\n")
    return found if found and not body else [*found, Said(echo, None, text)]


def _first_line(text: str) -> tuple[str, str]:
    parts = re.split(r"[\r\n]+", text, maxsplit=1)
    return parts[0].strip(), parts[1].strip("\0 \t\r\n") if len(parts) > 1 else ""
