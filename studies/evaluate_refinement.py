"""How much of the estimator's error joint refinement repairs, on synthetic people that training never meets.

    python studies/evaluate_refinement.py --people 16 --errors 1 2 --prior learned
    python studies/evaluate_refinement.py --people 16 --errors 1 --avatars --device cuda

Poses are off as in `oasis evaluate --dataset synthetic`, by the measured errors of the estimator; landmarks are
not given to the refinement, since none go with these. With --avatars, PSNR inside the mask of pictures in other poses,
of the prior's guess and of the adapted one, when the surface is the estimated, the refined or the true one; from photos
in any light after one gain a channel. Prints markdown.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.anchors import faces_of_vertices
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.camera import project
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import Camera, CanonicalGaussians, HandCrop, TrainingBatch
from oasis_warp.estimation.mirrored_input import array
from oasis_warp.estimation.refine import refine
from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.evaluation.held_out import (
    ERROR_STREAM,
    FIRST_PERSON,
    Lighting,
    Session,
    Shoot,
    as_estimated,
    estimator_noise,
    photograph,
    true_targets,
)
from oasis_warp.evaluation.metrics import Truth, match_colors, score
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import choose_prior
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.pretraining.training_batch import EstimatorNoise, training_batch
from oasis_warp.render.render import render

MARGIN = 0.0015
"""Depth by which a vertex may lie behind the nearest surface and count as visible [m]."""
MEASURES = {
    "px": "visible vertices, median [px]", "px90": "the same, 90 % of a hand [px]",
    "mm": "all vertices about their mean, median [mm]", "degrees": "finger joints, median [deg]",
    "iou": "outline against the true one, IoU",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One photo of a person, its estimated surface and its true one in the same crop."""

    crop: HandCrop
    truth: HandCrop
    batch: TrainingBatch


class Bench:
    """What all people are measured with."""

    def __init__(self, device: torch.device):
        self.hand, self.device = bundled_hand(), device
        self.there, self.rig = self.hand.to(device), HandKinematics(self.hand)
        self.vertex_faces = faces_of_vertices(self.there.faces, len(self.hand.template))

    def case(self, session: Session, light: Lighting, shoot: Shoot, factor: float) -> Case:
        """The same numbers drawn twice, so that the true surface is seen in the crop of the wrong mask."""
        batch = as_estimated(self.there, session, light, shoot, factor)
        (state,) = np.random.SeedSequence([shoot.seed, ERROR_STREAM, session.number]).generate_state(1)
        noise = EstimatorNoise(surface=0.0, mask=estimator_noise(factor).mask)
        random = torch.Generator().manual_seed(int(state))
        true = training_batch(
            self.there, session.photos[light], session.targets[light], shoot.size, random, noise
        )  # fmt: skip
        return Case(crop_of(batch), crop_of(true), batch)

    def errors(self, found: HandCrop, truth: HandCrop) -> dict[str, float]:
        """How far the posed surface is from the true one; keys as in `MEASURES`."""
        a, b = found.posed.vertices, truth.posed.vertices
        gap = (project(found.camera, a)[0] - project(truth.camera, b)[0]).norm(dim=1)
        seen = self.visible(truth)
        away = ((a - a.mean(0)) - (b - b.mean(0))).norm(dim=1)
        covered, true = self.outline(found), self.outline(truth)
        bent = np.abs(self.angles(found) - self.angles(truth))
        return {
            "px": float(gap[seen].median()),
            "px90": float(gap[seen].quantile(0.9)),
            "mm": 1000 * float(away.median()),
            "degrees": float(np.degrees(np.median(bent))),
            "iou": float((covered & true).sum() / (covered | true).sum()),
        }

    def visible(self, crop: HandCrop) -> Tensor:
        """Which vertices the photo shows."""
        vertices, camera = crop.posed.vertices, crop.camera
        every = torch.arange(len(vertices), device=self.device)
        return depth_visibility(
            vertices, vertices, self.there.faces, camera.K, camera.viewmat, camera.width, camera.height,
            margin=MARGIN, point_vertices=every,
        )[0] > 0.5  # fmt: skip

    def outline(self, crop: HandCrop) -> Tensor:
        """Pixels that the surface covers."""
        camera = crop.camera
        seen = depth_map(
            crop.posed.vertices, self.there.faces, camera.viewmat, camera.K, camera.width, camera.height,
            outputs=("face_ids",),
        )  # fmt: skip
        return seen.face_ids >= 0

    def angles(self, crop: HandCrop) -> np.ndarray:
        """The 26 angles of the model that is nearest to the surface."""
        K, rest = array(crop.camera.K), array(crop.rest.vertices)
        posed = array(crop.posed.vertices)
        return state_of_surface(self.rig, shape_of(self.rig, rest), rest, posed, K[0, 0], K[:2, 2]).state.angles

    def pictures(self, guess: CanonicalGaussians, case: Case, light: Lighting, truths: list[Truth]) -> Iterator[float]:
        """PSNR [dB] of the avatar in the pose and camera of each target."""
        batch, size = case.batch, case.batch.target_images.shape[2]
        for k, truth in enumerate(truths):
            posed = pose_gaussians(guess, self.there.faces, batch.rest[0], batch.target_posed[0, k])
            camera = Camera(batch.target_viewmats[0, k], batch.target_Ks[0, k], size, size)
            with torch.no_grad():
                image = render(posed, camera).image
            found = score(match_colors(image, truth.image, truth.mask) if light == "wild" else image, truth)["psnr"]
            if found is not None:
                yield found


def measure(bench: Bench, prior: Prior, options: argparse.Namespace) -> tuple[dict, dict]:
    """Errors, and PSNR, of everybody: by light and factor, and by light, factor, surface and stage."""
    surfaces, avatars = defaultdict(list), defaultdict(list)
    shoot = Shoot()
    for number in range(FIRST_PERSON + options.first, FIRST_PERSON + options.first + options.people):
        session = photograph(shoot, "ordinary", number, bench.device)
        for light in session.photos:
            exact = bench.case(session, light, shoot, 0.0)
            truths = true_targets(exact.batch, bench.there, bench.vertex_faces) if options.avatars else []
            for factor in options.errors:
                case = bench.case(session, light, shoot, factor)
                guess = prior(case.crop)
                start = time.perf_counter()
                refined = refine(bench.hand, guess, case.crop)
                seconds = time.perf_counter() - start
                before, after = (bench.errors(e, case.truth) for e in (case.crop, refined.crop))
                surfaces[light, factor].append((before, after, refined.accepted, seconds))
                if options.avatars:
                    for name, crop in (
                        ("estimated", case.crop), ("refined", refined.crop), ("true", case.truth)
                    ):  # fmt: skip
                        guess = prior(crop)
                        adapted = adapt(bench.hand, guess, crop, AdaptConfig(light="keep")).gaussians
                        for stage, gaussians in (("raw", guess), ("one-shot", adapted)):
                            found = bench.pictures(gaussians, case, light, truths)
                            avatars[light, factor, name, stage].append(float(np.mean(list(found))))
    return surfaces, avatars


def print_tables(surfaces: dict, avatars: dict) -> None:
    """Medians over the people, and means of PSNR."""
    for (light, factor), rows in surfaces.items():
        before, after, accepted, seconds = zip(*rows, strict=True)
        print(f"\nPhotos in {light} light, errors x {factor:g}, {len(rows)} people\n")
        print("| | estimated | refined | better for |\n|---|---|---|---|")
        for key, words in MEASURES.items():
            a, b = (np.array([row[key] for row in part]) for part in (before, after))
            better = np.mean(b > a if key == "iou" else b < a)
            print(f"| {words} | {np.median(a):.3g} | {np.median(b):.3g} | {100 * better:.0f} % |")
        print(f"\nTaken for {100 * np.mean(accepted):.0f} %; {np.median(seconds):.2f} s a photo.")
    for (light, factor, name, stage), values in avatars.items():
        print(f"{light}, errors x {factor:g}, {stage} on the {name} surface: {np.mean(values):.2f} dB")


def main() -> None:
    """Measure everybody and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=16)
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--errors", type=float, nargs="+", default=[1.0, 2.0], help="times those of the estimator")
    parser.add_argument("--avatars", action="store_true", help="reconstruct, too")
    parser.add_argument("--prior", default="learned", help="learned, none or a weights file")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    prior = choose_prior(options.prior if options.prior in ("learned", "none") else Path(options.prior))
    print_tables(*measure(Bench(torch.device(options.device)), prior, options))


if __name__ == "__main__":
    main()
