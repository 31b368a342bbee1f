"""How strong interreflections are: in shadow, a pixel shows nothing else.

Where all light comes directly, interreflections of a matte surface look like those of a flatter or steeper surface
without any (Nayar et al. 1991), so the values that are fitted do not tell how strong they are. Values in shadow do, and
no fit uses them.
"""

from __future__ import annotations

import numpy as np

from .dataset import LUMINANCE, Dataset

#: Fewest values in shadow that tell anything, and the largest factor: shadows of a wrong shape may be lit.
FEWEST, LARGEST = 10, 2.0


def strength(data: Dataset, indirect: np.ndarray, hidden: np.ndarray) -> float:
    """Factor by which interreflections, (P, K, 3), must be multiplied to be what is seen in shadow, least absolute
    deviations: the median of the ratios, weighted by the interreflections. From 0 to `LARGEST`; NaN if nothing is told.

    hidden : (P, K), bool, which values are in shadow. Values that cannot be told from 0 are not used.
    """
    shown, expected = data.luminance[:, data.lit], (indirect @ LUMINANCE)[:, data.lit]
    floor = shown[shown > 0].min(initial=np.inf)
    told = hidden[:, data.lit] & (expected > floor)
    if told.sum() < FEWEST:
        return np.nan
    ratio, weight = shown[told] / expected[told], expected[told]
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(np.clip(ratio[order][np.searchsorted(total, total[-1] / 2)], 0, LARGEST))
