"""Metrics: rendered pictures against true ones, as a whole and by parts of the hand, and coverage from all sides."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.avatar.anchors import OPACITY, place_anchors
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.core.bands import split_bands
from oasis_warp.core.camera import orbit_camera
from oasis_warp.evaluation import band_energy
from oasis_warp.evaluation.band_energy import BANDS, KEPT, SIZE, log_brightness
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import Perceptual, ssim_map
from oasis_warp.ops import depth_map

COVERED = 0.9
"""Alpha from which a pixel counts as covered."""
COVERAGE_POSES = ("rest", "fist", "pinch", "point")
COVERAGE_VIEWS = 8
MIN_PIXELS = 50
"""Fewest pixels of a part of the hand that is measured."""
ERROR_FLOOR = 1e-12
"""Smallest mean squared error: PSNR ends at 120 dB."""

Scores = dict[str, float | None]
"""By name of the measure; None where it cannot be measured."""
HIDDEN_CONTRASTS = tuple(f"hidden contrast {band}" for band in BANDS)
HIDDEN_LIKENESS = tuple(f"hidden likeness {band}" for band in BANDS)
MEASURES = (
    "psnr", "psnr_inner", "ssim", "ssim_box", "ssim_mask", "lpips", "psnr_visible", "psnr_hidden", "psnr_stretched",
    "psnr_squeezed", "psnr_unchanged", *HIDDEN_CONTRASTS, *HIDDEN_LIKENESS,
)  # fmt: skip


class TargetTruth(NamedTuple):
    """One true target."""

    image: Float[Tensor, "H W 3"]
    """Over black, times `mask`."""
    mask: Float[Tensor, "H W"]
    """Share of each pixel that is hand."""
    known: Float[Tensor, "H W"]
    """0 where something else may hide the hand, which is not compared."""
    hidden: Bool[Tensor, "H W"]
    """Surface that the photo does not show."""
    stretched: Bool[Tensor, "H W"]
    """Skin that the pose has stretched."""
    squeezed: Bool[Tensor, "H W"]
    """Skin that the pose has squeezed, as inside bent joints: its folds are darker than skin at rest."""
    interior: Bool[Tensor, "H W"]
    """Surface away from all outlines, those inside the hand included."""


def score(image: Float[Tensor, "H W 3"], truth: TargetTruth, perceptual: Perceptual | None = None) -> Scores:
    """Measure `image`, drawn over black, by every one of `MEASURES`.

    PSNR [dB] weighs pixels by the mask. The inner PSNR and those of parts leave out two pixels at the outline, which
    depend on the shape. SSIM is the mean over the whole picture, the mask's box, and the mask. LPIPS is of the hand.
    Of hidden skin there are its contrast over the truth's and its likeness (`compare_hidden_skin`).
    """
    drawn = image.clamp(0, 1) * truth.known[..., None]
    mask, error = truth.mask, (drawn - truth.image).square().mean(-1)
    inner = mask * (inner_mask(mask) > 0.5)
    similarity = ssim_map(drawn, truth.image)
    rows, columns = (torch.nonzero((mask > 0.5).any(axis))[:, 0] for axis in (1, 0))
    scores: Scores = {
        "psnr": _psnr(error, mask),
        "psnr_inner": _psnr(error, inner),
        "ssim": float(similarity.mean()),
        "ssim_box": None,
        "ssim_mask": float((similarity * mask).sum() / mask.sum().clamp_min(1)),
        "lpips": None,
    }
    if len(rows):
        box = similarity[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
        scores["ssim_box"] = float(box.mean())
    if perceptual is not None:
        scores["lpips"] = float(perceptual(drawn[None], truth.image[None], mask[None])[0])
    for name, part in {
        "visible": ~truth.hidden,
        "hidden": truth.hidden,
        "stretched": truth.stretched,
        "squeezed": truth.squeezed,
        "unchanged": ~(truth.stretched | truth.squeezed),
    }.items():
        scores[f"psnr_{name}"] = _psnr(error, inner * part)
    return scores | compare_hidden_skin(drawn, truth)


def compare_hidden_skin(drawn: Float[Tensor, "H W 3"], truth: TargetTruth) -> Scores:
    """Contrast of hidden skin over the truth's and correlation with it, in each of `band_energy.BANDS`.

    Those pixels count on which the truth has least contrast (`KEPT`). None of other sizes than `SIZE`, or too little
    skin.
    """
    names = (*HIDDEN_CONTRASTS, *HIDDEN_LIKENESS)
    where = truth.hidden & truth.interior & (truth.mask > 0.5) & (inner_mask(truth.known) > 0.5)
    if len(drawn) != SIZE or int(where.sum()) < band_energy.MIN_PIXELS:
        return dict.fromkeys(names)
    weight = where.to(drawn)
    own, true = (split_bands(log_brightness(picture), weight)[:, where] for picture in (drawn, truth.image))
    kept = true.square() <= true.square().quantile(KEPT, 1, keepdim=True)
    own, true = own * kept, true * kept
    energy, wanted = own.square().sum(1), true.square().sum(1).clamp_min(ERROR_FLOOR)
    likeness = (own * true).sum(1) / (energy * wanted).sqrt().clamp_min(ERROR_FLOOR)
    return dict(zip(names, [*(energy / wanted).sqrt().tolist(), *likeness.tolist()], strict=True))


def _psnr(error: Tensor, weight: Tensor) -> float | None:
    total = float(weight.sum())
    if total < MIN_PIXELS:
        return None
    return -10 * math.log10(max(float((error * weight).sum()) / total, ERROR_FLOOR))


def color_gain(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, "3"]:
    """The least-squares gain of each channel from `image` to `target` inside `mask`.

    A photo does not tell a coloured hand from coloured light, and the target has another light.
    """
    weighted = image * mask[..., None]
    return (weighted * target).sum((0, 1)) / (weighted * image).sum((0, 1)).clamp_min(1e-6)


def match_colors(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """`image` after `color_gain`, kept in [0, 1]."""
    return (image * color_gain(image, target, mask)).clamp(0, 1)


@torch.no_grad()
def coverage(avatar: Avatar, size: int = 256) -> Float[Tensor, "P C"]:
    """Share of the posed mesh's silhouette with alpha >= 0.9, for each pose and each of 8 views around it.

    The wrist's rim, where opacity fades out on purpose, is not part of the silhouette; where a learned prior made
    Gaussians fainter, it is.
    """
    faces, anchors = avatar.hand.faces, place_anchors(avatar.hand, avatar.rest)
    solid = torch.zeros(len(avatar.rest.vertices), device=avatar.device)
    solid[anchors.vertex_index] = anchors.opacities[: len(anchors.vertex_index)]
    solid_faces = (solid[faces] >= OPACITY - 1e-4).all(1)
    shares = torch.zeros(len(COVERAGE_POSES), COVERAGE_VIEWS)
    for p, name in enumerate(COVERAGE_POSES):
        pose = avatar.held(name)
        vertices = avatar.mesh(pose).vertices
        for c in range(COVERAGE_VIEWS):
            camera = orbit_camera(vertices, 2 * math.pi * c / COVERAGE_VIEWS, size=size)
            ids = depth_map(vertices, faces, camera.viewmat, camera.K, size, size).face_ids
            inside = (ids >= 0) & solid_faces[ids.clamp_min(0).long()]
            alpha = avatar.render(camera, pose).alpha
            shares[p, c] = (alpha[inside] >= COVERED).float().mean()
    return shares
