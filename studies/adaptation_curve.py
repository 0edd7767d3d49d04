"""Error against time of adaptation: its steps, LoRA's rank, reference views, resolution; each varied alone.

Fills docs/evaluation.md (curve). Synthetic people that no training has met, as in `oasis evaluate`, with the
estimator's errors.
"""

import functools
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import Camera, CanonicalGaussians, HandCrop, TrainingBatch
from oasis_warp.evaluation.columns import COLORS, LIGHTS
from oasis_warp.evaluation.held_out import CaptureConfig, Lighting, capture_person, estimated_batch, target_truths
from oasis_warp.evaluation.methods import LitGaussians, prior_digest
from oasis_warp.evaluation.metrics import TargetTruth, match_colors, score
from oasis_warp.evaluation.synthetic import crop_of, draw_targets
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.heads import ColorHeads
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.render.render import render
from studies.harness import Row, StudyOptions, measured, seconds
from studies.inputs import people, prior_named
from studies.tables import Section, complete, groups, markdown, mean

STEPS, RANKS, VIEWS, SIZES = (0, 10, 20, 40, 84, 200, 400, 1000), (1, 2, 4, 8, 16), (0, 1, 3, 7), (64, 128, 256)
"""Values of each setting; sizes are the side of the crop that is adapted to [px]; the prior reads the largest."""
FEW = 40
"""Steps of texture learning while another setting is varied."""
TEXTURES = ("field", "lora")


class Setting(NamedTuple):
    """One way to adapt."""

    config: AdaptConfig
    size: int = SIZES[-1]


DEFAULT, DEFAULT_TITLE = Setting(AdaptConfig()), "default: the field until its loss is flat"


def all_settings(longest: int = STEPS[-1]) -> dict[str, Setting]:
    """By title, in the order of the table; without those of more steps than `longest`."""
    rows = {DEFAULT_TITLE: DEFAULT, "`--light even`": Setting(AdaptConfig(light="even"))}
    for texture in TEXTURES:
        rows |= {f"{texture}, {n} steps": Setting(AdaptConfig(texture=texture, texture_steps=n)) for n in STEPS}
    rows |= {
        f"lora, {FEW} steps, rank {n}": Setting(AdaptConfig(texture="lora", texture_steps=FEW, lora_rank=n))
        for n in RANKS
    }
    for texture in TEXTURES:
        few = AdaptConfig(texture=texture, texture_steps=FEW)
        rows |= {
            f"{texture}, {FEW} steps, reference views: {n}": Setting(
                AdaptConfig(texture=texture, texture_steps=FEW, reference_views=n)
            )
            for n in VIEWS
        }
        every = AdaptConfig(texture=texture, texture_steps=FEW, references="all")
        rows[f"{texture}, {FEW} steps, all {every.reference_views} in each"] = Setting(every)
        rows |= {f"{texture}, {FEW} steps, {n} px": Setting(few, n) for n in SIZES}
    paper = AdaptConfig(texture="lora", calibration_steps=100, texture_steps=400, references="all")
    rows["the paper's 100 + 400 steps, all views in each"] = Setting(paper)
    return {title: setting for title, setting in rows.items() if (setting.config.texture_steps or 0) <= longest}


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"people", "lights", "longest"})
    prior: str = "learned"
    """learned, or a weights file."""
    people: int = 2
    lights: tuple[Lighting, ...] = ("same", "studio")
    longest: int = STEPS[-1]
    """Most steps tried."""


def shrink(crop: HandCrop, size: int) -> HandCrop:
    """The photo `size` pixels wide, a whole number of times smaller."""
    factor, K = len(crop.image) // size, crop.camera.K.clone()
    K[:2] /= factor

    def pooled(picture: torch.Tensor) -> torch.Tensor:
        return avg_pool2d(picture[None], factor)[0]

    return crop._replace(
        image=pooled(crop.image.permute(2, 0, 1)).permute(1, 2, 0).contiguous(),
        mask=pooled(crop.mask[None])[0],
        above_wrist=pooled(crop.above_wrist[None])[0],
        camera=Camera(crop.camera.viewmat, K, size, size),
    )


def own_psnr(crop: HandCrop, made: LitGaussians) -> float:
    """PSNR of the avatar over its photo, inside the outline [dB]."""
    faces, rest = bundled_hand().faces.to(crop.image.device), crop.rest.vertices
    light = None if made.light is None else (made.light, surface.vertex_normals(rest, faces))
    image, alpha = render(pose_gaussians(made.gaussians, faces, rest, crop.posed.vertices, light), crop.camera)
    return masked_psnr(image + (1 - alpha)[..., None] * crop.image, crop.image, inner_mask(crop.mask))


class Targets(NamedTuple):
    """One person's other poses and views."""

    batch: TrainingBatch
    rotations: torch.Tensor | None
    truths: list[TargetTruth]
    colors: str

    def psnr(self, made: LitGaussians) -> float | None:
        """Of an avatar, inside the outline: mean of the targets [dB]."""
        found, hand = [], bundled_hand().to(self.batch.rest.device)
        for image, truth in zip(draw_targets(made, hand, self.batch, self.rotations), self.truths, strict=True):
            judged = match_colors(image, truth.image, truth.mask) if self.colors == "matched" else image
            found.append(score(judged, truth)["psnr_inner"])
        return mean(found)


class Subject(NamedTuple):
    """One person in one light, and what the prior says of the photo."""

    crop: HandCrop
    guess: CanonicalGaussians
    heads: ColorHeads
    targets: Targets
    weights: str | None


@functools.lru_cache(1)
def subject(light: Lighting, number: int, options: Options) -> Subject:
    """Photograph a person, and load all kernels before anything is timed."""
    prior, device, capture = prior_named(options.prior), torch.device(options.device), CaptureConfig(size=SIZES[-1])
    if not isinstance(prior, NetworkPrior):
        raise SystemExit(f"--prior {options.prior}: has no heads to train; name a learned one.")
    hand = bundled_hand().to(device)
    person = capture_person(capture, "ordinary", number, device)
    batch, exact = (estimated_batch(hand, person, light, capture, factor) for factor in (1.0, 0.0))
    truths = target_truths(exact, hand)
    crop = crop_of(batch)
    guess, heads = prior.with_heads(crop)
    for texture in TEXTURES:
        adapt(bundled_hand(), [guess], [crop], AdaptConfig(texture=texture, texture_steps=2), heads=heads)
    targets = Targets(batch, person.light_rotations[light], truths, COLORS[light])
    return Subject(crop, guess, heads, targets, prior_digest(prior))


def measure(light: Lighting, number: int, title: str, options: Options) -> Row:
    """One setting for one person in one light."""
    crop, guess, heads, targets, weights = subject(light, number, options)
    config, size = all_settings()[title]
    device, small = torch.device(options.device), shrink(crop, size)
    start = seconds(device)
    made = adapt(bundled_hand(), [guess], [small], config, heads=heads)
    taken, adapted = seconds(device) - start, LitGaussians(made.gaussians, made.light)
    return {
        "light": light, "person": number, "title": title, "seconds": taken, "steps": len(made.losses),
        "own": own_psnr(crop, adapted), "other": targets.psnr(adapted), "weights": weights, "device": options.device,
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every setting for everybody in every light."""
    cases = {
        f"{light}, person {k}: {title}": (light, k, title, options)
        for light in options.lights for k in people(options.people) for title in all_settings(options.longest)
    }  # fmt: skip
    return measured("adaptation_curve", cases, measure, options)


def curve_text(rows: list[Row]) -> str | None:
    """A table for each light, of the settings that were measured for everybody."""
    rows, parts = complete(rows), []
    for (light,), own in groups(rows, "light").items():
        count = len({row["person"] for row in own})
        default = {row["person"]: row["seconds"] for row in own if row["title"] == DEFAULT_TITLE}
        lines = []
        for title in all_settings():
            found = [row for row in own if row["title"] == title]
            if found and len(found) == count:
                steps, psnr, other = (mean(row[key] for row in found) for key in ("steps", "own", "other"))
                time = mean(row["seconds"] / default[row["person"]] for row in found)
                lines.append([title, f"{steps:.0f}", f"{psnr:.2f}", f"{other:.2f}", f"{time:.2f}"])
        words = LIGHTS[light]
        headings = ["", "steps", "own photo", "other poses and views", "time"]
        parts.append(f"{words[0].upper()}{words[1:]}; people: {count}:\n\n{markdown(headings, lines)}")
    about = f"Weights {str(rows[0]['weights'])[:12]}, {rows[0]['device']}." if rows else ""
    return "\n\n".join([*parts, about]) if parts else None


SECTIONS = (Section("evaluation.md", "curve", curve_text),)
