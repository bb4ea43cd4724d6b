"""What an export takes from a run's memory: how old each pixel is, what changed, and what it was before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flows.archive.export_layers import ExportedRun, Layer, Rows, image_layer, seat_layer
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.beliefs import OLD_CLASS, unpacked_days
from storage.arrays.class_maps import legend_of
from storage.arrays.layout import open_group
from storage.export.image_files import CogImage
from storage.export.stac_items import classes

BELIEF, GROUND = "belief", "ground_map"


def memory_layers(run: ExportedRun) -> list[Layer]:
    """Days since each pixel was looked at; of a run that goes on from another what changed, and from which class.

    On the map where there is a pose. A run that believes nothing, of an earlier version, has none of them.
    """
    layers = []
    if (product := _product_with(run, "age")) is not None:
        seen = _ages(run) if product == BELIEF else image_layer(run, product, "age", ("age",), nodata=np.nan)
        layers.append(Layer("age", "Days since the pixel was looked at", ("data",), *seen, "days"))
    if (product := _product_with(run, "changed")) is not None:
        title = "Share of the patch's pixels with another class than remembered"
        if product == BELIEF:
            changed = seat_layer(run, BELIEF, "changed", ("changed",))
        else:
            changed = image_layer(run, product, "changed", ("changed",), nodata=np.nan)
        layers.append(Layer("changed", title, ("data",), *changed, "1"))
    if (product := _product_with(run, OLD_CLASS)) is not None:
        legend = legend_of(open_group(run.path(product)))
        was = image_layer(run, product, OLD_CLASS, ("class",), nodata=UNLABELLED, legend=legend)
        title = "Class remembered, where the map is sure of another one"
        layers.append(Layer(OLD_CLASS, title, ("data",), *was, fields=classes(legend)))
    return layers


def _product_with(run: ExportedRun, array: str) -> str | None:
    """The store of which an image is taken: the map on the ground, else what is believed; None where neither has it."""
    products = (name for name in (GROUND, BELIEF) if run.store(name) is not None)
    return next((name for name in products if array in open_group(run.path(name))), None)


def _ages(run: ExportedRun) -> tuple[CogImage, Callable[[], Rows]]:
    """Ages of the field's own pixels, unpacked: few readers of GeoTIFF know of scales."""
    image, packed = image_layer(run, BELIEF, "age", ("age",), nodata=np.nan)
    return replace(image, dtype="float32"), lambda: ((first, unpacked_days(rows)) for first, rows in packed())
