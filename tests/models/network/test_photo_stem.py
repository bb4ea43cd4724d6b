"""Check the encoder for large frames."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from spectralzoom.models.network.photo_stem import NormedConv, PhotoStem
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import PLANES, SegmenterConfig
from spectralzoom.models.weights.files import load_encoder, load_weights, save_weights
from tests.models.conftest import make_weights


@pytest.mark.parametrize(("kernel", "stride", "seen"), [(3, 1, (3, 5)), (3, 2, (4, 6)), (5, 1, (2, 6)), (5, 2, (3, 7))])
def test_filters_lie_as_in_tensorflow(kernel: int, stride: int, seen: tuple[int, int]) -> None:
    """At strides of 2 the pixel 4 / stride of the result sees one pixel more after its own than before it."""
    conv = NormedConv(1, 1, kernel, stride).eval()
    image = torch.zeros(1, 1, 12, 12, requires_grad=True)
    found = conv(image)
    assert found.shape[2:] == (12 // stride, 12 // stride)
    found[0, 0, 4 // stride, 4 // stride].backward()
    rows = image.grad[0, 0].abs().sum(dim=1).nonzero()[:, 0]
    assert (rows.min(), rows.max()) == seen


def test_features_have_the_sizes_of_the_levels() -> None:
    """They are those of a U-Net of four levels, finest first."""
    found = PhotoStem(2 + PLANES, [8, 16, 32, 64])(torch.zeros(2, 2 + PLANES, 64, 96))
    assert [tuple(one.shape) for one in found] == [(2, 8 << i, 64 >> i, 96 >> i) for i in range(4)]


def test_the_shipped_encoder_has_every_convolution_and_norm() -> None:
    """Only layers that depend on the columns, the widths or the classes start at random."""
    model = Segmenter(SegmenterConfig(classes=3, columns=2, patch=32, layers=1, deep=True))
    left = model.load_state_dict(load_encoder(), strict=False)
    assert not left.unexpected_keys
    own = {name.split(".")[1] for name in left.missing_keys if name.startswith("overview_stem.")}
    assert own == {"enter", "colours", "sides", "low"}


@pytest.mark.parametrize("columns", [1, 2, 3, 48])
def test_colours_are_the_last_middle_and_first_column(columns: int) -> None:
    """Columns ascend with the wavelength; each colour has half of a column's spread."""
    weight = PhotoStem(columns + PLANES, [8, 16, 32, 64]).colours.weight[:, :, 0, 0]
    assert torch.equal(weight.sum(dim=1), torch.full((3,), 0.5))
    places = (weight[:, :columns] * torch.arange(columns)).sum(dim=1) / 0.5
    torch.testing.assert_close(places, torch.tensor([columns - 1, (columns - 1) / 2, 0.0]))


def test_batch_norms_are_stored(tmp_path: Path) -> None:
    """Weights read from a file have the means and variances of a training, and so the same overview."""
    weights = make_weights(columns=2, patch=32, deep=True)
    for name, tensor in weights.segmenter.state_dict().items():
        if name.endswith("running_var"):
            tensor.fill_(0.5)
    save_weights(weights, tmp_path / "a.safetensors")
    image = torch.randn(1, 2 + PLANES, 32, 32)
    with torch.no_grad():
        before, after = (
            one.segmenter.eval().read_overview(image) for one in (weights, load_weights(tmp_path / "a.safetensors"))
        )
    assert torch.equal(before.logits, after.logits)
    assert torch.equal(before.features, after.features)
