"""What a mosaic is made of: opened sweeps, or paths from which any process opens the same sweeps itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.resample import Kernel
from pipeline.rectify.tie_points import TieTable
from pipeline.rectify.tracks import Track
from storage.arrays.cubes import open_raw_cube
from storage.arrays.located_sweeps import Sighted, sight_sweeps
from storage.arrays.lookups import open_lookup

Tables = Mapping[str, Sequence[tuple[Track, TieTable]]]


@dataclass(frozen=True)
class MosaicWork:
    """What a mosaic is made of, and with what."""

    placed: Sequence[Placed]
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"


@dataclass(frozen=True)
class MosaicRecipe:
    """The same by absolute paths: small, hashable, and good in every process that sees them."""

    raw: Path  # folder of raw cubes
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    lookup: Path | None = None  # tables of the sweeps; None looks lines up directly
    registration: Path | None = None  # record of the corrections

    @property
    def folders(self) -> list[Path]:
        """What has to be seen by whoever makes tiles."""
        given = (self.raw, self.lookup, None if self.registration is None else self.registration.parent)
        return [path for path in given if path is not None]

    def sweeps(self) -> list[Sighted]:
        """Open the sweeps, in the order of their names.

        Raises
        ------
        IncompleteStoreError : one is missing or damaged.
        """
        cubes = [open_raw_cube(path) for path in sorted(self.raw.glob("*.zarr"))]
        return sight_sweeps(cubes, self.registration, self.camera)

    def open(self) -> MosaicWork:
        """Open the sweeps and find where their lines lie, from stored tables where there are some.

        Raises
        ------
        IncompleteStoreError : a sweep or the tables are missing or damaged.
        """
        tables: Tables = {} if self.lookup is None else open_lookup(self.lookup)
        placed = [_with_tables(one, self.camera, tables) for one in self.sweeps()]
        return MosaicWork(placed, self.camera, self.grid, self.kernel)


def _with_tables(one: Sighted, camera: LineCamera, tables: Tables) -> Placed:
    """A sweep with its stored tables; without, where its lines lie too unevenly for one."""
    stored = tables.get(one.cube.sweep.name)
    return Placed(one.cube, tuple(stored), one.gain) if stored else one.placed(camera)
