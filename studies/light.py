"""What light is usual on hands in rooms, and what of a photo's skin is found again on other photos of the same hand.

"usual" gives the constants of adaptation/sh_lighting.py: each synthetic person is photographed five times in one light,
and that light is fitted to all five pictures, the learned prior's calibrated guess at the estimated pose being the
skin: four harmonics per colour, as the photo's camera sees it. "persistence" gives those of
adaptation/albedo_shading.py and a table of docs/avatar.md: an avatar is made of every photo, and what it learned beyond
the prior's guess is compared, vertex by vertex, with what avatars of the other photos of the hand did.
"""

from dataclasses import dataclass
from itertools import pairwise, permutations
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt, remove_photo_light, view_in_photo
from oasis_warp.adaptation.calibrate import calibrate
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.sh_lighting import DARK, MOST, marks
from oasis_warp.avatar.anchors import vertex_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import GAMMA, pose_gaussians, posed_normals, with_shade_baked
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.hand_crop import crop_hand, initial_offsets
from oasis_warp.evaluation.held_out import CaptureConfig, capture_person, estimated_batch
from oasis_warp.evaluation.same_hand import photos_of_hands
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.hand.template import bundled_hand
from oasis_warp.render.render import render
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import SAME_HAND, fit_largest, people, prior_named
from studies.tables import Column, Section, table

OTHERS = 100
"""Numbers from those of the evaluation on, so that these are other people."""
LEAST = 0.05
"""Share of hand in a pixel by which colours are divided at least."""
TINY = 1e-3
"""Ridge towards an even light."""
ANGLES = (0, 15, 30, 45, 70, 180)
"""Between which the skin has turned [degrees]."""
LENGTHS = (0.016, 0.008, 0.004, 0.002)
"""Over which what is seen changes along the skin [m]."""
SHOWN = 0.3
"""Confidence from which a photo shows a vertex."""
QUANTILES = (0.5, 0.9, 0.98, 0.99, 0.999)


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "people", "photos"})
    parts: tuple[Literal["usual", "persistence"], ...] = ("usual", "persistence")
    people: int = 40
    photos: Path = SAME_HAND
    """A folder of photos for each hand."""


@torch.no_grad()
def measure_light(number: int, prior: str) -> Row:
    """Harmonics of the light on one person, [4, 3]."""
    hand, capture = bundled_hand(), CaptureConfig()
    person = capture_person(capture, "ordinary", number, torch.device("cpu"))
    batch = estimated_batch(hand, person, "same", capture, 1.0)
    crop, rotations = crop_of(batch), person.light_rotations["same"]
    guess = prior_named(prior)(crop)
    _, view, trusted = view_in_photo(hand, guess, crop)
    colors = calibrate(view, guess.colors, crop.image, trusted, AdaptConfig()).apply(guess.colors)
    skin = guess._replace(colors=colors)

    own = (crop.posed.vertices, crop.camera, crop.image, crop.mask, torch.eye(3))
    pictures = [own] + [
        (posed, Camera(viewmat, K, *image.shape[1::-1]), image / mask.clamp_min(LEAST)[..., None], mask, rotation)
        for posed, viewmat, K, image, mask, rotation in zip(
            batch.target_posed[0], batch.target_viewmats[0], batch.target_Ks[0], batch.target_images[0],
            batch.target_masks[0], rotations, strict=True,
        )
    ]  # fmt: skip
    normal, right = torch.zeros(3, 4, 4), torch.zeros(3, 4, 1)
    for posed, camera, image, mask, rotation in pictures:
        target = crop._replace(posed=crop.posed._replace(vertices=posed), camera=camera, image=image, mask=mask)
        drawn, alpha = render(pose_gaussians(skin, hand.faces, crop.rest.vertices, posed), camera)
        seen = observe(hand, target)
        known = observe(hand, target._replace(image=drawn / alpha.clamp_min(LEAST)[..., None])).colors
        known, light = known.clamp(0, 1) ** GAMMA, seen.colors.clamp(0, 1) ** GAMMA
        directions = posed_normals(crop.rest.vertices, posed, hand.faces) @ rotation
        terms = torch.cat([torch.ones_like(directions[:, :1]), directions], 1) * known.T[..., None]
        weighted = terms * seen.confidence[:, None]
        ridge = TINY * (seen.confidence[:, None] * known.square()).sum(0)[:, None, None] * torch.eye(4)
        normal += weighted.mT @ terms + ridge
        right += weighted.mT @ light.T[..., None] + ridge[..., :1]
    return {"harmonics": torch.linalg.solve(normal, right)[..., 0].T.tolist()}


class Beyond(NamedTuple):
    """What one photo shows beyond the prior's guess."""

    differences: Tensor
    """Of the logarithms of colours, by lengths along the skin, from the longest on: [5, V, 3]."""
    confidence: Tensor
    facing: Tensor


def read_photo_beyond(path: Path, options: Options) -> Beyond:
    """What the avatar of a photo learned beyond the guess."""
    hand, config = bundled_hand(), AdaptConfig(texture_steps=options.steps)
    photo = read_photo(path)
    fit = fit_largest(photo, force=False)
    crop = crop_hand(photo, fit, initial_offsets(hand, fit), ReconstructConfig(size=256))
    with torch.no_grad():
        guess = prior_named(options.prior)(crop)
        sure, light = remove_photo_light(hand, guess, crop, view_in_photo(hand, guess, crop).weights, config)
    made = adapt(hand, [guess], [crop], config)
    assert light is not None and light.facing is not None
    learned = vertex_colors(with_shade_baked(made.gaussians), len(hand.template))
    guessed = vertex_colors(guess._replace(colors=made.calibration.apply(guess.colors)), len(hand.template))
    whole = (learned.clamp_min(DARK) / guessed.clamp_min(DARK)).log().clamp(-MOST, MOST)
    confidence = observe(hand, sure).confidence
    smooth = [inpaint(crop.rest.vertices, hand.faces, whole, confidence, length) for length in LENGTHS]
    parts = [smooth[0], *(fine - coarse for coarse, fine in pairwise(smooth)), whole - smooth[-1]]
    return Beyond(torch.stack(parts), confidence, light.facing)


def measure_hand(paths: list[Path], options: Options) -> Row:
    """Of all pairs of photos of one hand: sums of products, by angle and length; and moments of the differences."""
    photos = []
    for path in paths:
        try:
            photos.append(read_photo_beyond(path, options))
        except InputError as error:
            print(f"left out: {error}")
    sums = torch.zeros(2, len(ANGLES) - 1, len(LENGTHS) + 1)
    for one, other in permutations(photos, 2):
        both = (one.confidence > SHOWN) & (other.confidence > SHOWN)
        angle = (one.facing * other.facing).sum(-1).clamp(-1, 1).arccos().rad2deg()
        for k, (least, most) in enumerate(pairwise(ANGLES)):
            chosen = both & (angle >= least) & (angle < most)
            weight = (one.confidence * other.confidence)[chosen, None]
            a, b = one.differences[:, chosen], other.differences[:, chosen]
            sums[0, k] += (weight * a * b).sum((1, 2))
            sums[1, k] += (weight * a * a).sum((1, 2))
    whole = torch.cat([photo.differences.sum(0)[photo.confidence > SHOWN] for photo in photos])
    return {"sums": sums.tolist(), "differences": whole[::7].tolist()}


def run(options: Options) -> list[Row]:
    """Measure."""
    rows = []
    if "usual" in options.parts:
        cases = {f"person {k}": (k, options.prior) for k in people(options.people, first=OTHERS)}
        rows += measured("light", cases, measure_light, options)
    if "persistence" in options.parts:
        hands = {name: (paths, options) for name, paths in photos_of_hands(options.photos).items()}
        rows += measured("light", hands, measure_hand, options)
    return rows


def usual(rows: list[Row]) -> str | None:
    """Mean and covariance of the harmonics over people and colours."""
    found = [row["harmonics"] for row in rows if "harmonics" in row]
    if len(found) < 2:
        return None
    each = torch.tensor(found).permute(0, 2, 1).reshape(-1, 4)
    torch.set_printoptions(precision=3, sci_mode=False)
    return f"mean {each.mean(0)}\ncovariance\n{torch.cov(each.T)}"


def gains(rows: list[Row]) -> list[Row]:
    """The share of what one photo shows that is found again on another, by angle and length."""
    found = [torch.tensor(row["sums"]) for row in rows if "sums" in row]
    if not found:
        return []
    products, squares = torch.stack(found).sum(0)
    return [
        {"angle": f"{least} to {most}°", "gains": gain.tolist()}
        for (least, most), gain in zip(pairwise(ANGLES), products / squares, strict=True)
    ]


def line_of_light(rows: list[Row]) -> str | None:
    """How colours of one photo differ from the guess, along the line of light and shadow and across it."""
    whole = torch.tensor([one for row in rows for one in row.get("differences", ())])
    if not len(whole):
        return None
    spread, axes = torch.linalg.eigh(whole.T @ whole / len(whole))
    across = (whole @ (axes[:, :2] / spread[:2].sqrt())).norm(dim=1)
    lines = ["deviations of differences of logarithms, and directions over them, across and along:"]
    for deviation, direction in zip(spread.sqrt().tolist(), axes.T.tolist(), strict=True):
        lines.append(f"  {deviation:.3f}: {', '.join(f'{x / deviation:.1f}' for x in direction)}")
    for name, values in {"across [deviations]": across, "brighter [mean logarithm]": whole.mean(1)}.items():
        quantiles = values.quantile(torch.tensor(QUANTILES)).tolist()
        shares = (f"{share:.1%} below {value:.2f}" for share, value in zip(QUANTILES, quantiles, strict=True))
        lines.append(f"{name}: {', '.join(shares)}")
    return "\n".join([*lines, f"taken for marks: {float(marks(whole).mean()):.1%}"])


NAMES = [f"{1000 * length:g} mm" for length in LENGTHS]
SECTIONS = (
    Section(None, "usual light", usual),
    Section("avatar.md", "persistence", table(
        (
            Column("turned by", "angle"),
            *(
                Column(name, lambda row, k=k: row["gains"][k], ".2f")
                for k, name in enumerate(
                    (f"over {NAMES[0]}", *(f"{a} to {b}" for a, b in pairwise(NAMES)), f"under {NAMES[-1]}")
                )
            ),
        ),
        gains,
    )),
    Section(None, "line of light", line_of_light),
)  # fmt: skip
