"""Where fields lie: ground summed by the numbers of their pixels, whoever knows how large these are."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox

from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import NoPlace, PlacedPicture, PosedField, areas_by_number
from pipeline.ground.georeference import class_areas_m2
from pipeline.ground.map_grid import ground_grid
from tests.pipeline.ground.test_ground import view

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # odc-geo on affine 3
SHAPE = (600, 30)  # more rows than are taken at once
CLASSES = np.random.default_rng(0).choice(np.array([0, 2, UNLABELLED], np.uint8), SHAPE)


def test_before_a_rig_they_are_those_of_the_map_on_the_ground() -> None:
    """Of a field whose upper rows see the sky; what is of no class counts nothing."""
    grid = ground_grid(view(tilt_deg=2.0), SHAPE)
    assert areas_by_number(PosedField(grid), CLASSES, 3) == pytest.approx(grid.class_areas_m2(CLASSES, 3), rel=1e-12)


def test_on_a_georeferenced_picture_they_are_of_the_ellipsoid() -> None:
    """As hectares of classes are, on a grid that is turned."""
    geobox = GeoBox(SHAPE, Affine(4.33, 2.5, 534_257, 2.5, -4.33, 5_772_301), "EPSG:32632")
    wanted = class_areas_m2(geobox, CLASSES, 3)
    assert areas_by_number(PlacedPicture(geobox), CLASSES, 3) == pytest.approx(wanted, rel=1e-9)


def test_numbers_outside_are_left_out_and_unknown_ground_is_none() -> None:
    """Those below 0 and from the count on; nothing is summed where nobody knows how large a pixel is."""
    numbers = np.array([[-1, 0, 0], [1, 2, 7]])
    found = areas_by_number(NoPlace((2, 3), pixel_m=0.5), numbers, 2)
    assert found is not None
    assert found.tolist() == [0.5, 0.25]
    assert areas_by_number(NoPlace((2, 3)), numbers, 2) is None
    with pytest.raises(ShapeError, match=r"field of \(2, 3\) px \(y, x\), got \(3, 2\)"):
        areas_by_number(NoPlace((2, 3)), numbers.T, 2)
