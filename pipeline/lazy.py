"""Compute values and import modules when they are first used."""
# ruff: noqa: F401 - imported from here

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from threading import Lock
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

Value = TypeVar("Value")


class Once(Generic[Value]):
    """Call ``make`` once, in the thread that needs it first, while others wait; after an error it is called again.

    Compares equal only to itself.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make: Callable[[], Value] | None = make
        self._made: list[Value] = []
        self._lock = Lock()

    @staticmethod
    def of(value: Value) -> Once[Value]:
        """Hold a value that is already known."""
        once = Once(lambda: value)
        once()
        return once

    def is_made(self) -> bool:
        """Return whether the value is known."""
        return bool(self._made)

    def __call__(self) -> Value:
        """Return the value; the first call computes it."""
        with self._lock:
            if self._make is not None:
                self._made.append(self._make())
                self._make = None  # frees its inputs
            return self._made[0]


class DeferredModule(ModuleType):
    """A module that is imported when one of its names is first used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


def deferred(name: str) -> Any:
    """Return a module that is imported at its first use; packages that are listed below are imported from here.

    Write it beside the import for type checkers, as below.
    """
    return DeferredModule(name)


# Import them from here: each takes half a second or more, and most commands need few of them.
if TYPE_CHECKING:
    import dask
    import dask.distributed as dask_distributed
    import geopandas
    import h5py
    import odc.geo.crs as odc_crs
    import odc.geo.geobox as odc_geobox
    import odc.geo.warp as odc_warp
    import odc.geo.xr as odc_xr
    import prosail
    import pvlib
    import pyogrio
    import pyproj
    import rasterio
    import rasterio.features as rasterio_features
    import rasterio.warp as rasterio_warp
    import safetensors.torch as safetensors_torch
    import shapely
    import spyndex
    import torch
    from odc.geo.geobox import GeoBox
    from shapely.geometry.base import BaseGeometry
    from torch import Tensor
else:
    BaseGeometry = GeoBox = Tensor = Any  # only type checkers look at them
    for _name in (
        *("dask", "dask.distributed", "geopandas", "h5py", "odc.geo.crs", "odc.geo.geobox", "odc.geo.warp"),
        *("odc.geo.xr", "prosail", "pvlib", "pyogrio", "pyproj", "rasterio", "rasterio.features", "rasterio.warp"),
        *("safetensors.torch", "shapely", "spyndex", "torch"),
    ):
        globals()[_name.replace("odc.geo", "odc").replace(".", "_")] = deferred(_name)
