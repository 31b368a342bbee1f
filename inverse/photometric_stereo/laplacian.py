"""Equations of weighted graph Laplacians on pixels."""

from __future__ import annotations

import numpy as np
import pyamg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rimlight.edge_sampling.refusals import Refusal

#: Unknowns that are solved for directly. Beyond, factorisation is slower than multigrid, and takes more memory.
DIRECT = 200_000

#: Of conjugate gradients, at most; 10 to 30 are usual.
ITERATIONS = 200


def solve(A: sp.csr_matrix, b: np.ndarray, start: np.ndarray, *, tolerance: float = 1e-8) -> np.ndarray:
    """Solve A x = b: by factorisation, or by conjugate gradients with smoothed aggregation (PyAMG) if it is large.

    A : (N, N), symmetric, positive definite. b, start : (N,). tolerance : length of the residual over that of b.

    Raises
    ------
    RuntimeError : the residual did not fall so far.
    """
    if len(b) <= DIRECT:
        return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(b)
    levels = pyamg.smoothed_aggregation_solver(A, symmetry="symmetric", max_coarse=500)
    residuals: list[float] = []
    x = levels.solve(b, x0=start, tol=tolerance, accel="cg", maxiter=ITERATIONS, residuals=residuals)
    if residuals[-1] > 1.01 * tolerance * np.linalg.norm(b):
        raise Refusal(f"integrate: no solution within {ITERATIONS} iterations")
    return x
