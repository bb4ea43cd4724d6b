"""Stages that do something else in a test, or are of another version."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from flows.survey.survey import STAGES


def act_instead(patch: pytest.MonkeyPatch, name: str, wants: Callable[..., Any]) -> None:
    """Have a stage tell something else when it is asked what it wants."""
    patch.setitem(STAGES, name, replace(STAGES[name], wants=wants))


def be_version(patch: pytest.MonkeyPatch, product: str, version: int) -> None:
    """Have all stages of a product write another version of it."""
    for name, stage in list(STAGES.items()):
        if stage.product.name == product:
            patch.setitem(STAGES, name, replace(stage, product=replace(stage.product, version=version)))
