"""Processes that are to be there as long as this one, and no longer: guarded, kept up, ended."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

LARGEST_LOG = 10_000_000  # bytes; a larger one is begun anew


def end_with_us(process: int) -> Callable[[], None]:
    """Have a process ended (SIGTERM) when this one is gone, however it went.

    Gives what lets the process go. It is to be called as soon as the process has been waited for: from then on its
    number may be that of another.
    """
    reading, writing = os.pipe()  # the system closes the end held here, and the shell's read fails
    words = ["sh", "-c", 'read -r nothing || kill "$0" 2>/dev/null', str(process)]
    try:
        guard = os.posix_spawn(
            "/bin/sh", words, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, reading, 0)], setpgroup=0
        )
    except OSError:
        os.close(writing)
        raise
    finally:
        os.close(reading)

    def let_go() -> None:
        with suppress(OSError):  # a guard that is gone already
            os.write(writing, b"\n")
        os.close(writing)
        with suppress(ChildProcessError):
            os.waitpid(guard, 0)

    return let_go


class KeptProcess:
    """A process that ends with this one and is started again where it has died; what it says goes to ``log``.

    ``patience_s`` is how long it may take to end when it is told to [s]; ``environment`` is added to that of this one.
    """

    def __init__(
        self, command: Sequence[str], log: Path, patience_s: float, environment: Mapping[str, str] | None = None
    ) -> None:
        self.log = log
        self._command, self._patience_s, self._environment = list(command), patience_s, dict(environment or {})
        self._process: subprocess.Popen[bytes] | None = None
        self._let_go: Callable[[], None] | None = None

    def keep_up(self) -> bool:
        """Start it where it does not run; whether it was started."""
        if self.runs():
            return False
        self.log.parent.mkdir(parents=True, exist_ok=True)
        grown = self.log.exists() and self.log.stat().st_size > LARGEST_LOG
        with self.log.open("wb" if grown else "ab") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env={**os.environ, **self._environment}
            )
        self._let_go = end_with_us(self._process.pid)
        return True

    def runs(self) -> bool:
        """Whether it was started and has not ended."""
        if self._process is not None and self._process.poll() is not None:
            self._forget()
        return self._process is not None

    def restart(self) -> None:
        """End it and start it again; processes that it has started go on by themselves."""
        self.stop()
        self.keep_up()

    def stop(self) -> None:
        """End it."""
        if self._process is not None and self.runs():
            self._process.terminate()
            try:
                self._process.wait(self._patience_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._forget()

    def _forget(self) -> None:
        """It has been waited for."""
        let_go, self._let_go, self._process = self._let_go, None, None
        if let_go is not None:
            let_go()
