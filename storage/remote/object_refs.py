"""What an archive in a bucket hands out: stores that are fetched when somebody asks where they lie, runs to upload."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage.archive.addresses import StageRef
from storage.archive.run_folders import RunDraft


@dataclass(frozen=True, eq=False, repr=False)
class RemoteRef(StageRef):
    """A store that may not be on this machine yet: whoever asks for its path has it fetched, and waits."""

    fetch: Callable[[str], None]

    def __getattribute__(self, name: str) -> Any:
        if name == "path":
            object.__getattribute__(self, "fetch")(self.uri)
        return object.__getattribute__(self, name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StageRef) and (self.stage, self.key) == (other.stage, other.key)

    def __hash__(self) -> int:
        return hash((self.stage, self.key))

    def __repr__(self) -> str:
        return f"RemoteRef({self.uri!r})"


class RemoteRun(RunDraft):
    """A run that is uploaded once it is published in the working copy."""

    send: Callable[[str], None]

    def publish(self, *, rests_on: Mapping[str, str] | None = None, **facts: Any) -> Path:
        """Publish the run here and in the bucket; gives its folder here."""
        folder = super().publish(rests_on=rests_on, **facts)
        self.send(f"runs/{self.id}")
        return folder
