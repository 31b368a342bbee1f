"""How uncertain normals are: by how much they turn when parts of the lights are left out, in turns."""

from __future__ import annotations

import numpy as np

from .alternation import Alternations, State, View
from .direct import DirectModel, own
from .vectors import unit

#: Parts of the lights that are left out in turns, and steps by which normals follow.
PARTS, STEPS = 8, 3

#: Fewest lights of which parts tell anything, and fewest values of a pixel that must be kept each time.
FEWEST, TELLING = 8, 4


def of_normals(work: Alternations, state: State, view: View) -> np.ndarray:
    """Standard errors of the normals of a state, degrees, (P,): root mean squares of the angle to what more lights
    would tell, by the jackknife. NaN where too few values count.

    The BSDF, the exposures, shadows and interreflections are held, and so are not in it: what all lights have in common
    is never seen.

    work : of the kind of the state. view : of the state.
    """
    P, K, _ = work.data.values.shape
    if K < FEWEST:
        return np.full(P, np.nan)
    counts = (work.judge.counts * view.seen).astype(np.float32)
    model = DirectModel(work.data, work.lobes, points=view.points, counts=counts, indirect=view.indirect)
    part = np.random.default_rng([work.judge.seed, 22]).permutation(K) % PARTS
    found, told = np.empty((PARTS, P, 3), np.float32), np.ones(P, bool)
    for i in range(PARTS):
        kept = counts * (part != i)
        model.counts = own(kept)
        turned = state.guess.of(np.arange(P))
        model.fit_normals(turned, steps=STEPS, free_albedo=work.options.albedo)
        found[i], told = turned.normals, told & ((kept > 0).sum(1) >= TELLING)
    off = found - unit(found.mean(0))
    squares = (PARTS - 1) / PARTS * (off**2).sum((0, 2))
    return np.where(told, np.degrees(np.sqrt(squares)), np.nan)
