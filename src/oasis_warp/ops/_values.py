"""`core.checks.check_finite` for the operators' implementations, where it is part of every call."""

import torch
from torch import Tensor

from oasis_kernels.finite import ALL_FINITE
from oasis_warp.core import checks
from oasis_warp.ops._launch import has_vectors, run_native


def check_finite(**tensors: Tensor | None) -> None:
    """Refuse NaN, infinities and absurd magnitudes.

    Raises:
        ValueError: names the argument and how many of its values are bad.
    """
    given = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None}
    quick = [t for t in given.values() if has_vectors(t) and t.is_contiguous()]
    if quick:
        arrays = torch.tensor([(t.data_ptr(), t.numel()) for t in quick])
        found = torch.zeros(1, dtype=torch.int64)
        run_native(
            ALL_FINITE, {"arrays": arrays.data_ptr(), "count": len(quick), "found": found.data_ptr()}, n_tasks=1
        )
        if not found[0]:
            given = {name: t for name, t in given.items() if not any(t is known for known in quick)}
    checks.check_finite(**given)  # also for the words, where something was found
