"""Draw a prediction as every target of a training batch shows it."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.types import TrainingBatch
from oasis_warp.network.anchors import rim_fade
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.inputs import Prediction
from oasis_warp.network.prior import all_gaussians
from oasis_warp.ops import depth_map, rasterization


class Pictures(NamedTuple):
    """N = B T pictures over black; what their targets say nothing about is black, too."""

    images: Float[Tensor, "N H H 3"]
    alphas: Float[Tensor, "N H H"]


def draw_targets(prediction: Prediction, batch: TrainingBatch, network: HandNetwork) -> Pictures:
    """Pose and draw the Gaussians of every hand in the pose and camera of each of its targets."""
    size = batch.target_images.shape[2]
    images, alphas = [], []
    for hand in range(len(batch.rest)):
        canonical = all_gaussians(prediction, hand, network.vertex_index, network.face_index)
        posed = pose_gaussians(canonical, network.faces, batch.rest[hand], batch.target_posed[hand])
        for target, (means, quats, scales) in enumerate(zip(*posed[:3], strict=True)):
            image, alpha, _ = rasterization(
                means, quats, scales, posed.opacities, posed.colors, batch.target_viewmats[hand, target][None],
                batch.target_Ks[hand, target][None], size, size, validate=False,
            )  # fmt: skip
            images.append(image[0])
            alphas.append(alpha[0, ..., 0])
    known = batch.target_known.flatten(0, 1)
    return Pictures(torch.stack(images) * known[..., None], torch.stack(alphas) * known)


@torch.no_grad()
def true_pictures(batch: TrainingBatch, faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"]) -> Pictures:
    """The targets, faded out at the wrist as the Gaussians are: what these may not cover they must not be asked for."""
    size = batch.target_images.shape[2]
    seen = depth_map(
        batch.target_posed.flatten(0, 1), faces, batch.target_viewmats.flatten(0, 1), batch.target_Ks.flatten(0, 1),
        size, size, validate=False,
    )  # fmt: skip
    at_vertices = rim_fade(batch.rest, rim).repeat_interleave(batch.target_posed.shape[1], 0)
    corners = faces[seen.face_ids.clamp_min(0).long()]
    at_corners = at_vertices.gather(1, corners.flatten(1)).view(corners.shape)
    fade = torch.where(seen.face_ids >= 0, (at_corners * seen.barycentrics).sum(-1), 1)
    share = fade * batch.target_known.flatten(0, 1)
    return Pictures(batch.target_images.flatten(0, 1) * share[..., None], batch.target_masks.flatten(0, 1) * share)
