"""Pictures that JPEG changed: by how much is told from the files, and said if it is much."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from photometric import write_jpeg
from PIL import Image
from scipy import fft

from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import compression, dataset, inspection, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset
from rimlight.inverse.photometric_stereo.reconstruction import Reconstruction

TEXT = "The pictures are JPEG"


@pytest.fixture(scope="module", params=["folds", "sphere"])
def data(request: pytest.FixtureRequest) -> Dataset:
    bsdf = "glaze:0.1,0.2,0.5|glaze:0.6,0.5,0.4"
    options = simulation.Options(shape=request.param, bsdf=bsdf, size=64, lights=16, spp=16, max_depth=3, seed=3)
    return simulation.simulate(options, progress=False)[0]


def off(found: Dataset, data: Dataset) -> float:
    """Standard deviation of what pictures are changed by, over the median value."""
    change = found.luminance - data.luminance / data.values.max()
    return float(np.sqrt(np.square(change).mean()) / np.median(data.luminance / data.values.max()))


@pytest.mark.parametrize("quality", [10, 25, 50, 75, 90])
def test_how_far_values_are_off(data: Dataset, tmp_path: Path, quality: int) -> None:
    found = dataset.read(write_jpeg(tmp_path, data, quality))
    told = compression.judged(tmp_path, found.names, found.mask)
    assert abs(told.quality - quality) < 2
    print(quality, told.deviation, off(found, data))
    assert 0.5 < told.deviation / off(found, data) < 2


@pytest.mark.parametrize(("quality", "said"), [(10, True), (95, False)])
def test_strong_compression_is_said(data: Dataset, tmp_path: Path, caplog, quality: int, said: bool) -> None:
    """Where the files are read, by the reconstruction, whose result keeps it, and by the inspection."""
    read = ps.read(write_jpeg(tmp_path, data, quality))
    assert (TEXT in caplog.text) == said
    doubts = Reconstruction(read, ps.Options()).data.doubts
    seen = inspection.inspect(tmp_path)
    for found in (doubts, inspection.warnings(seen)):
        assert any(f"{TEXT} of quality {quality}" in text for text in found) == said
    assert dict(inspection.table(seen))["compression"].startswith(f"quality about {quality}, changes values by")


def test_other_pictures_are_not_compressed(data: Dataset, tmp_path: Path) -> None:
    dataset.write(tmp_path, data)
    found = inspection.inspect(tmp_path)
    assert found.compression.said() == [] and "compression" not in dict(inspection.table(found))


def test_pictures_smaller_than_a_block(tmp_path: Path) -> None:
    Image.new("RGB", (7, 20)).save(tmp_path / "1.jpg", quality=5)
    assert compression.judged(tmp_path, ["1.jpg"], np.ones((20, 7), bool)).said() == []


def test_width_of_a_distribution() -> None:
    """Of coefficients that are rounded to 0 for the most part, as if they had been seen."""
    rng = np.random.default_rng(0)
    true = rng.laplace(0, 4, (40000, 8, 8))
    true[:, 0, 0] = rng.uniform(-500, 500, 40000)
    steps = np.full(true.shape, 24.0)
    rounded = steps * np.round(true / steps)

    luma = fft.idctn(rounded, axes=(1, 2), norm="ortho") + 128
    expected = np.sqrt(np.square(rounded - true).mean())
    np.testing.assert_allclose(compression.deviation(luma, steps), expected, rtol=0.05)
