"""How much a target's sigma owes to uneven light: the slope of the light, holes apart."""

import numpy as np
import pytest

from sl_calibration.data.view_extraction import light_slope
from support.scenes.plate_scenes import PLATE, drawn, pinhole

AT_PX = np.stack(np.meshgrid(np.arange(60, 350, 20), np.arange(60, 250, 20)), axis=-1)


@pytest.mark.parametrize("slope", [0.0, 2e-4, 1e-3])
def test_slope_is_that_of_the_light(slope):
    """A plate in light that grows as exp(slope u).

    Noise, 1 DN of 190 in some thousand pixels over a baseline of 100, is below 1e-6; the small
    holes' rims, half in and half out of the cells, leave some 5e-5.
    """
    image = drawn(PLATE, pinhole()).astype(np.float32)
    ramp = np.exp(slope * (np.arange(400) - 400.0)).astype(np.float32)
    found = light_slope(image * ramp, AT_PX.reshape(-1, 2).astype(float))
    assert np.median(found) == pytest.approx(slope, rel=0.1, abs=8e-5)
