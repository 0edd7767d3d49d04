"""Load the bundled hand, or the one that was chosen."""

import functools
import os
import warnings
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel

HandName = Literal["bundled", "mano"]
MANO_DIR = "OASIS_MANO_DIR"
"""Environment variable that names the folder with MANO's files."""


def chosen_hand(name: HandName, mano_dir: Path | str | None = None) -> HandModel:
    """The bundled hand, or MANO's from `mano_dir`, else from the folder that the variable `MANO_DIR` names.

    Raises:
        InputError: MANO is wanted but no folder is given, or `hand.mano_hand.mano_hand` refuses it.
    """
    if name == "bundled":
        return bundled_hand()
    from oasis_warp.hand.mano_hand import mano_hand  # most programs never need it

    folder = mano_dir or os.environ.get(MANO_DIR)
    if not folder:
        raise InputError(
            f"the hand model MANO: expected the folder with MANO_RIGHT.pkl, got none; set {MANO_DIR} to it, or give "
            "it to `oasis reconstruct` as --mano-dir."
        )
    return mano_hand(Path(folder).absolute())


@functools.cache
def bundled_hand() -> HandModel:
    """The permissive hand that ships with the package: 12,337 vertices, 24,608 faces, 40 shapes, 30 pose correctives.

    Made by `asset_build/build_hand.py` from CC0 data. Float tensors are float32 on the CPU.
    """
    with asset("hand", "hand_right.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = {key: stored[key] for key in stored.files}
    n_fine, n_base = (int(n) for n in arrays["hd_shape"])
    rows = np.repeat(np.arange(n_fine), np.diff(arrays["hd_indptr"]))
    places = torch.from_numpy(np.stack([rows, arrays["hd_indices"].astype(np.int64)]))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse invariant checks are implicitly disabled")  # torch 2.11: always
        subdivision = torch.sparse_coo_tensor(
            places, torch.from_numpy(arrays["hd_data"]).double(), (n_fine, n_base), check_invariants=True
        )

    def subdivide(key: str) -> Tensor:
        """An array of the base vertices on the HD mesh. The last base vertex only closes the wrist and is dropped."""
        base = torch.from_numpy(arrays[key])[:n_base].double()
        return (subdivision @ base.flatten(1)).unflatten(1, base.shape[1:]).float()

    def real(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

    def whole(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.int64))

    return HandModel(
        name="bundled",
        template=subdivide("v_template"),
        faces=whole(arrays["hd_faces"]),
        weights=subdivide("weights"),
        shape_basis=subdivide("shapedirs"),
        shape_names=tuple(str(name) for name in arrays["shape_names"]),
        joints=real(arrays["joints"]),
        joint_basis=real(arrays["joint_shapedirs"]),
        tips=real(arrays["tips"]),
        tip_basis=real(arrays["tip_shapedirs"]),
        parents=tuple(int(p) for p in arrays["parents"]),
        joint_names=tuple(str(name) for name in arrays["joint_names"]),
        pose_axes=real(arrays["pose_axes"]),
        pose_limits=real(arrays["pose_limits"]),
        rest_bend=real(arrays["rest_bend"]),
        keypoint_index=whole(arrays["kp21"]),
        corrective_basis=subdivide("correctives"),
        uv=real(arrays["hd_uv"]),
        uv_faces=whole(arrays["hd_uv_faces"]),
        rim=whole(arrays["hd_loop"]),
        segment=whole(arrays["hd_segment"]),
        region=whole(arrays["hd_side"]),
        bone_t=real(arrays["hd_bone_t"]),
        bone_theta=real(arrays["hd_bone_theta"]),
        nail=real(arrays["hd_nail"]),
        licence=str(arrays["licence"]),
    )
