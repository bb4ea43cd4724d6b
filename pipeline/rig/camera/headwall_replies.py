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
MOST_PROMPTS = 16  # in the texts of one reply

# a telnet server's negotiations; JSON in UTF-8 never holds the byte FF
_NEGOTIATION = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)


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
    """Takes bytes as they come and gives what stands before each prompt, once the prompt is whole.

    Each byte is looked at a bounded number of times, however few come at once and whatever they are.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._looked = 0  # bytes in which no prompt begins that ends a reply
        self._passed = 0  # prompts among them

    @property
    def held(self) -> bytes:
        """Bytes that no prompt has followed yet."""
        return bytes(self._held)

    def feed(self, data: bytes) -> list[Said]:
        """Take bytes; give what is complete, which may be nothing or several replies.

        Raises
        ------
        RigError : more came without a prompt than any reply has.
        """
        cut = max(len(self._held) - 2, 0)  # a negotiation may have come in part
        self._held[cut:] = _NEGOTIATION.sub(b"", bytes(self._held[cut:]) + data)
        said: list[Said] = []
        while (end := self._prompt_at()) >= 0:
            said += _parse(bytes(self._held[:end]))
            del self._held[: end + len(PROMPT)]
            self._looked = self._passed = 0
        if len(self._held) > LONGEST_REPLY:
            raise RigError(f"{len(self._held)} bytes came without a prompt 'hpi> '; is this the camera's control port?")
        return said

    def _prompt_at(self) -> int:
        """Where the first prompt is: at a line's start, or right behind a reply (a text in a reply may hold one)."""
        while (at := self._held.find(PROMPT, self._looked)) >= 0:
            if at == 0 or self._held[at - 1] in b"\r\n":
                return at
            if any(said.reply is not None for said in _parse(bytes(self._held[:at]))):
                return at
            self._looked, self._passed = at + 1, self._passed + 1
            if self._passed > MOST_PROMPTS:
                raise RigError(
                    f"{self._passed} prompts 'hpi> ' came within one reply, {self.held[:80]!r} and on; is this the "
                    "camera's control port?"
                )
        self._looked = max(len(self._held) - len(PROMPT) + 1, self._looked)
        return -1


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
