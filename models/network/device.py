"""Where networks compute: on the processor, or on an accelerator that the machine has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from pipeline.errors import SettingsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")

Device = Literal["auto", "cpu", "cuda", "mps"]
Present = Literal["cpu", "cuda", "mps"]
PROCESSOR: Present = "cpu"


def choose_device(asked: str) -> Present:
    """Name the device that is asked for; of ``auto`` the first accelerator that torch can use here, else ``cpu``.

    Raises SettingsError: torch can use no such device on this machine; says which there are.
    """
    if asked == PROCESSOR:  # known without torch
        return PROCESSOR
    there: list[Present] = [PROCESSOR]
    if torch.backends.mps.is_available():
        there.insert(0, "mps")
    if torch.cuda.is_available():
        there.insert(0, "cuda")
    found = next((name for name in there if asked in ("auto", name)), None)
    if found is None:
        known = ", ".join(get_args(Device))
        why = "torch can use none on this machine" if asked in get_args(Device) else f"it is one of {known}"
        raise SettingsError(f"--device {asked}: {why}; there is {', '.join(there)}: give that, or auto")
    return found
