"""Factors of sparse positive definite matrices."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu


def factorized(system: sparse.sparray, order: str = "NATURAL") -> SuperLU:
    """Factors of a positive definite matrix, in its precision. It is fast without pivots and column by column."""
    return splu(system.tocsc(), permc_spec=order, diag_pivot_thresh=0.0, panel_size=1, options={"SymmetricMode": True})


def sparse_order(system: sparse.sparray) -> np.ndarray:
    """The order of rows and columns in which a positive definite matrix has sparse factors (minimum degree)."""
    return np.argsort(factorized(system, "MMD_AT_PLUS_A").perm_c)
