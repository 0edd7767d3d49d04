"""Load the bundled hand."""

import functools

import numpy as np
import torch
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.core.hand_model import HandModel


@functools.cache
def bundled_hand() -> HandModel:
    """The permissive hand that ships with the package: 12,337 vertices, 24,608 faces, 40 shape coefficients.

    Made by `tools/build_hand.py` from CC0 data. Float tensors are float32 on the CPU.
    """
    with asset("hand", "hand_right.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = {key: stored[key] for key in stored.files}
    n_vertices, n_base = (int(n) for n in arrays["hd_shape"])

    def subdivide(base: np.ndarray) -> np.ndarray:
        """Carry an array over the base vertices to the HD mesh: CSR rows times the array; no row is empty."""
        flat = base[:n_base].reshape(n_base, -1).astype(np.float64)
        rows = arrays["hd_data"].astype(np.float64)[:, None] * flat[arrays["hd_indices"]]
        return np.add.reduceat(rows, arrays["hd_indptr"][:-1], axis=0).reshape(n_vertices, *base.shape[1:])

    def real(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))

    def whole(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.int64))

    return HandModel(
        name="bundled",
        template=real(subdivide(arrays["v_template"])),
        faces=whole(arrays["hd_faces"]),
        weights=real(subdivide(arrays["weights"])),
        shape_basis=real(subdivide(arrays["shapedirs"])),
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
        corrective_basis=real(subdivide(arrays["correctives"])),
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
