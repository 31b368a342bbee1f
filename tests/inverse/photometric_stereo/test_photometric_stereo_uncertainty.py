"""Standard errors of normals, against simulated truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rimlight.exr import read_exr
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import output, simulation
from rimlight.inverse.photometric_stereo.dataset import angles

QUICK = {"resolutions": (1.0,), "iterations": (2,), "max_depth": 2, "brightness": 0.0}


def found(noise: float, **options) -> tuple[ps.Result, float]:
    """Of a matte ball, and the root mean square error of its normals, degrees."""
    given = {"size": 24, "lights": 16, "spp": 256, "max_depth": 2, "seed": 5, "noise": noise, **options}
    data, _ = simulation.simulate(simulation.Options(**given), progress=False)
    result = ps.reconstruct(data, ps.Options(**QUICK, reflectance=False), progress=False)
    return result, float(np.sqrt(np.square(angles(result.guess.normals, data.truth)).mean()))


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_standard_errors_are_those_of_normals(noise: float, tmp_path: Path) -> None:
    """Where the model is right. 400 pixels tell a root mean square within some 5 %."""
    result, error = found(noise)
    assert result.verdict == "judged" and np.isfinite(result.uncertainty).all()
    assert 0.75 < error / np.sqrt(np.square(result.uncertainty).mean()) < 1.25
    output.write_pictures(tmp_path, result)
    picture = read_exr(tmp_path / "uncertainty.exr")[0][""][..., 0]
    np.testing.assert_allclose(picture[result.data.mask], result.uncertainty, rtol=1e-6)
    assert np.isnan(picture[~result.data.mask]).all()


def test_few_lights_tell_no_standard_error() -> None:
    assert np.isnan(found(0.01, lights=7)[0].uncertainty).all()
