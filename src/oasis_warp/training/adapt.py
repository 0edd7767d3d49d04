"""One-shot adaptation: a prior's guess becomes the hand of one photo."""

from typing import NamedTuple

import torch

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.observe import inner_mask, observe
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import CanonicalGaussians, Evidence
from oasis_warp.render.cameras import orbit_camera
from oasis_warp.training.calibrate import Calibration, calibrate
from oasis_warp.training.complete import complete_field
from oasis_warp.training.texture import learn_texture
from oasis_warp.training.views import freeze_view, reference_azimuths


class Adaptation(NamedTuple):
    """The fitted Gaussians and how they came about."""

    gaussians: CanonicalGaussians
    calibration: Calibration
    losses: tuple[float, ...]
    """Of texture learning, a step each."""


def adapt(
    hand: HandModel,
    prior: CanonicalGaussians,
    evidence: Evidence,
    config: AdaptConfig = AdaptConfig(),  # noqa: B008 - frozen
    progress: Progress = silent,
) -> Adaptation:
    """Fit the colours of `prior` to the photo; geometry stays.

    Colour calibration first, then the seen colours are carried smoothly over the rim of the seen region, then texture
    learning with reference views.
    """
    faces = hand.faces.to(evidence.image.device)
    posed = pose_gaussians(prior, faces, evidence.rest.vertices, evidence.posed.vertices)
    view = freeze_view(posed, evidence.camera)
    trusted = inner_mask(evidence.mask, 1) * (view.alphas[..., 0] > 0.5)

    progress("calibration", 0, 1)
    calibration = calibrate(view, prior.colors, evidence.image, trusted, config)
    gaussians = prior._replace(colors=calibration.apply(prior.colors))
    progress("calibration", 1, 1)

    progress("completion", 0, 1)
    seen = observe(hand, evidence)
    index = gaussians.vertex_index
    missing, known = torch.zeros_like(seen.colors), torch.zeros_like(seen.confidence)
    missing[index] = seen.colors[index] - gaussians.colors[: len(index)]
    known[index] = seen.confidence[index]  # where a prior put no Gaussian there is nothing to differ from
    difference = complete_field(evidence.rest.vertices, faces, missing, known)
    colors = (gaussians.colors + vertex_to_gaussians(difference, faces, gaussians)).clamp(0, 1)
    gaussians = gaussians._replace(colors=colors)
    progress("completion", 1, 1)

    references = [
        freeze_view(posed, orbit_camera(evidence.posed.vertices, azimuth, size=evidence.camera.width))
        for azimuth in reference_azimuths(config.reference_views)
    ]
    texture = learn_texture(
        gaussians, faces, view, evidence.image, evidence.mask * trusted, references, config, progress
    )
    return Adaptation(gaussians._replace(colors=texture.colors), calibration, texture.losses)
