"""The mirror controller's two modes: found at connect, whichever it is in, and changed without moving anything."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeadlinePassed, DeviceRefused
from pipeline.rig.mirror import simple_mode
from pipeline.rig.mirror.mirror_requests import ProLink, SimpleLink
from pipeline.rig.mirror.pro_payloads import ask_status, cell_int, go_simple
from pipeline.rig.mirror.steering import Identity

LOG = logging.getLogger(__name__)
KNOWN_MODELS = ("MR-E", "MRE")  # begin the ids of the controllers that the documents are of


class Modes:
    """A controller whose mode is known. Between calls it is in pro mode."""

    def __init__(self, pro: ProLink) -> None:
        self.pro = pro
        self.found_in_pro = False  # at the last connect, where an earlier session had left it
        self._lines = SimpleLink(pro.wire)

    def connect(self) -> Identity:
        """Find the controller in either mode, ask what it is, and leave it in pro mode. Nothing moves.

        Raises
        ------
        DeadlinePassed : nothing answers in either mode.
        RigError : something else answers.
        DeviceGone : the port went away.
        """
        with self.pro.wire.lock:
            self.found_in_pro = False
            try:
                self._greet()
            except DeadlinePassed:
                LOG.info("%s does not answer in simple mode; it may be in pro mode", self.pro.wire.port)
                self._leave_pro()
                self.found_in_pro = True
            words = (simple_mode.ID, simple_mode.VERSION, simple_mode.SERIAL)
            device, version, serial = (self._text(word) for word in words)
            self._enter_pro()
            return Identity(device, version, serial)

    @contextmanager
    def simple(self) -> Iterator[SimpleLink]:
        """Simple mode for as long as the block lasts.

        Raises
        ------
        DeadlinePassed, DeviceRefused, DeviceGone : a mode was not reached; connect again.
        """
        with self.pro.wire.lock:
            self._leave_pro()
            try:
                yield self._lines
            finally:
                self._enter_pro()

    def _leave_pro(self) -> None:
        try:
            self.pro.tell(go_simple(), "changing to simple mode")
        except DeadlinePassed as error:  # it may have changed all the same; the greeting tells
            LOG.info("%s; greeting it all the same", error)
        self._greet()

    def _greet(self) -> None:
        try:
            self._lines.start()
        except DeviceRefused as error:  # the greeting ended a line that somebody had begun
            LOG.info("%s; greeting it once more", error)
            self._lines.start()

    def _enter_pro(self) -> None:
        words = simple_mode.GO_PRO_CRC if self.pro.with_crc else simple_mode.GO_PRO
        try:
            self._lines.tell(words)
        except DeadlinePassed as error:  # it may have changed all the same; the status tells
            LOG.info("%s; asking for the status all the same", error)
        except DeviceRefused as error:
            raise DeviceRefused(f"{error}. Firmware without {words}? Turn mirror.with_crc over") from error
        self.pro.ask(ask_status(), "the status", cell_int)

    def _text(self, request: str) -> str:
        """The answer to a request that other firmware may not know."""
        try:
            return self._lines.text(request)
        except DeviceRefused as error:
            LOG.warning("%s", error)
            return ""


def check_identity(identity: Identity, port: str, expected: str) -> None:
    """Refuse a controller whose id does not hold ``expected``, in either case; nothing expected accepts all.

    Raises
    ------
    RigError : another device.
    """
    if expected.lower() not in identity.device.lower():
        raise RigError(
            f"expected a controller whose id holds {expected!r} on {port}, got {identity.device!r}; is this the mirror?"
        )


def check_model(identity: Identity, port: str, expected: str) -> None:
    """Refuse to move what is no controller that the documents are of, unless the settings expect it by its id.

    Raises
    ------
    RigError : another model, or another device altogether.
    """
    if not expected and not identity.device.upper().startswith(KNOWN_MODELS):
        raise RigError(
            f"firmware not known on {port}: {identity.words}; expected an id that begins with {KNOWN_MODELS[0]}: is "
            "another device at this port? If it is the mirror, set rig.expected_id to a part of its id"
        )
