"""Measure what light is usual on hands in rooms: the constants of adaptation/sh_lighting.py.

    python studies/measure_light.py --people 40

Each synthetic person is photographed five times in one light. That light is fitted to all five pictures, the learned
prior's calibrated guess at the estimated pose being the skin: four harmonics a colour, as the photo's camera sees it.
Printed are their mean and covariance over people and colours.
"""

import argparse

import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import in_photo
from oasis_warp.adaptation.calibrate import calibrate
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import GAMMA, pose_gaussians, posed_normals
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera
from oasis_warp.evaluation.held_out import FIRST_PERSON, Shoot, as_estimated, photograph
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import NetworkPrior, bundled_prior
from oasis_warp.render.render import render

OTHERS = 100
"""Numbers from those of the evaluation on, so that these are other people."""
LEAST = 0.05
"""Share of hand in a pixel by which colours are divided at least."""
TINY = 1e-3
"""Ridge towards an even light."""


def light_of(hand: HandModel, prior: NetworkPrior, number: int) -> Tensor:
    """Harmonics of the light on person `number`, [4, 3]."""
    shoot = Shoot()
    session = photograph(shoot, "ordinary", FIRST_PERSON + OTHERS + number, torch.device("cpu"))
    batch = as_estimated(hand, session, "same", shoot, 1.0)
    crop, turns = crop_of(batch), session.turns["same"]
    guess = prior(crop)
    _, view, trusted = in_photo(hand, guess, crop)
    colors = calibrate(view, guess.colors, crop.image, trusted, AdaptConfig()).apply(guess.colors)
    skin = guess._replace(colors=colors)

    own = (crop.posed.vertices, crop.camera, crop.image, crop.mask, torch.eye(3))
    pictures = [own] + [
        (posed, Camera(viewmat, K, shoot.size, shoot.size), image / mask.clamp_min(LEAST)[..., None], mask, turn)
        for posed, viewmat, K, image, mask, turn in zip(
            batch.target_posed[0], batch.target_viewmats[0], batch.target_Ks[0], batch.target_images[0],
            batch.target_masks[0], turns, strict=True,
        )
    ]  # fmt: skip
    normal, right = torch.zeros(3, 4, 4), torch.zeros(3, 4, 1)
    for posed, camera, image, mask, turn in pictures:
        there = crop._replace(
            posed=crop.posed._replace(vertices=posed), camera=camera, image=image, mask=mask
        )
        drawn, alpha = render(pose_gaussians(skin, hand.faces, crop.rest.vertices, posed), camera)
        seen = observe(hand, there)
        known = observe(hand, there._replace(image=drawn / alpha.clamp_min(LEAST)[..., None])).colors
        known, light = known.clamp(0, 1) ** GAMMA, seen.colors.clamp(0, 1) ** GAMMA
        directions = posed_normals(crop.rest.vertices, posed, hand.faces) @ turn
        basis = torch.cat([torch.ones_like(directions[:, :1]), directions], 1)
        terms = basis * known.T[..., None]
        weighted = terms * seen.confidence[:, None]
        ridge = TINY * (seen.confidence[:, None] * known.square()).sum(0)[:, None, None] * torch.eye(4)
        normal += weighted.mT @ terms + ridge
        right += weighted.mT @ light.T[..., None] + ridge[..., :1]
    return torch.linalg.solve(normal, right)[..., 0].T


def main() -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=40)
    args = parser.parse_args()
    hand, prior = bundled_hand(), bundled_prior()
    with torch.no_grad():
        lights = torch.stack([light_of(hand, prior, number) for number in range(args.people)])
    each = lights.permute(0, 2, 1).reshape(-1, 4)
    torch.set_printoptions(precision=3, sci_mode=False)
    print(f"mean {each.mean(0)}\ncovariance\n{torch.cov(each.T)}")


if __name__ == "__main__":
    main()
