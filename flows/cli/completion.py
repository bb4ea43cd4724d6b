"""The verb that completes the others: a script for the shell, made of every verb and flag that there is."""

from __future__ import annotations

import sys
from typing import Literal

from flows.cli.app import build_app


def completion(shell: Literal["bash", "zsh", "fish"]) -> int:
    """Print a script by which SHELL completes verbs, flags and choices of spectralzoom.

    For bash: spectralzoom completion bash > ~/.local/share/bash-completion/completions/spectralzoom

    Parameters
    ----------
    shell
        bash, zsh (as _spectralzoom in a folder of its fpath) or fish (in ~/.config/fish/completions).
    """
    sys.stdout.write(build_app(listed=False).generate_completion(prog_name="spectralzoom", shell=shell))
    return 0
