"""What the dense network says about synthetic photos of people that it has not met, against the truth of each pixel.

Fills docs/dense_network.md (file, held-out, landmarks, skin), and draws what it says about real photos.
"""

import hashlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.sky import harmonic_basis
from oasis_warp.core.bands import split_bands
from oasis_warp.core.types import Photo
from oasis_warp.estimation.estimator import choose_hand
from oasis_warp.estimation.pixel_reading import read_pixels
from oasis_warp.evaluation.band_energy import contrasts
from oasis_warp.evaluation.views import RIM
from oasis_warp.network.dense_network import HAND, DenseNetwork, DensePrediction, load_dense_network, read_dense_header
from oasis_warp.pretraining.dense_trainer import DensePhotos, detected
from oasis_warp.synthetic.dense_pictures import UNIT, DenseBatch, render_dense
from oasis_warp.synthetic.shots import SceneConfig, cached_identity, sample_table
from studies.harness import Row, StudyOptions, measured
from studies.inputs import estimator, iou, photo_named
from studies.tables import Column, Section, distribution, markdown, mean, percentiles, write_jpeg

PHOTOS_EACH = 4
CLAIMED = 0.9
"""Share of coordinates that lie within this quantile of their Laplace distribution, if the confidence is true."""
MIN_SKIN = 200
"""Pixels of visible skin below which a photo says little."""
SHOWN = ("palm_flat_right_03.jpg", "two_fingers_dark_skin_16.jpg", "ok_sign_left_10.jpg", "pointing_side_right_11.jpg")
"""Photos of the tests that are drawn."""
GAMMA = 2.2
BESIDE = 6
"""Width of the strip along arms and along what covers the hand, in which the end of the hand is hard to tell [px]."""
DARKEST = 1e-3
"""Reflectance below which its logarithm counts as this one's."""
MEASURES = (
    Column("IoU of the mask", "iou", ".3f"),
    Column("the same, 6 px away from arms and what covers the hand", "iou_apart", ".3f"),
    Column("the true mask moved by half a pixel, IoU with itself", "iou_half", ".3f"),
    Column("surface point, median of a photo, mm", "surface_mm", ".1f"),
    Column("surface point, 90 % of a photo, mm", "surface_90_mm", ".1f"),
    Column("normal, median of a photo, degrees", "normal_deg", ".1f"),
    Column("finger, share of pixels right", "finger", ".3f"),
    Column("albedo, scale-free error of the logarithm", "albedo_log", ".3f"),
    Column("the same for the photo divided by a fit of nine harmonics", "split_log", ".3f"),
    Column("albedo's contrast over the truth's, 1-2 px", "contrast_1_2", ".2f"),
    Column("albedo's contrast over the truth's, 2-4 px", "contrast_2_4", ".2f"),
    Column("albedo's contrast over the truth's, 4-8 px", "contrast_4_8", ".2f"),
    Column("shading, correlation of the logarithm", "shading", ".3f"),
)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    weights: Path | None = None
    """Weights file of `oasis pretrain --task dense`; that of the package when not given."""
    people: int = 32
    """Each shows PHOTOS_EACH photos."""
    seed: int = 77
    """Seed of a world that training does not use."""


def errors(said: DensePrediction, true: DenseBatch, k: int) -> Row | None:
    """What is wrong in photo `k`; None where hardly any skin is visible."""
    skin = true.skin[k]
    if int(skin.sum()) < MIN_SKIN:
        return None
    off = (said.surface[k] - true.surface[k])[:, skin]
    distance = off.norm(dim=0) * UNIT * 1e3
    cosine = (said.normal[k] * true.normal[k]).sum(0)[skin].clamp(-1, 1)
    albedo, known = (values[:, skin].clamp_min(DARKEST).log() for values in (_linear(said.albedo[k]), true.albedo[k]))
    light = _linear(true.image[k])[:, skin].clamp_min(DARKEST).log()
    mask, drawn = true.classes[k, HAND] > 0.5, said.classes[k].softmax(0)[HAND] > 0.5
    other = (true.classes[k].argmax(0) > HAND).float()[None]
    apart = torch.nn.functional.max_pool2d(other, 2 * BESIDE + 1, 1, BESIDE)[0] == 0
    linear = _linear(true.image[k])[:, skin]
    basis = harmonic_basis(said.normal[k][:, skin].T, 9)
    lit = (basis @ torch.linalg.lstsq(basis, linear.T).solution).T
    split = (linear / lit.clamp_min(DARKEST)).clamp_min(DARKEST).log()
    within = off.abs() / said.log_scale[k][skin].exp() < -torch.log(torch.tensor(1 - CLAIMED))
    return {
        "iou": iou(drawn, mask), "iou_apart": iou(drawn, mask, apart),
        "iou_half": mean(iou(moved, mask) for moved in half_a_pixel_off(true.classes[k, HAND])),
        "surface_mm": float(distance.median()), "surface_90_mm": float(distance.quantile(0.9)),
        "normal_deg": float(cosine.acos().rad2deg().median()),
        "finger": float((said.finger[k].argmax(0) == true.finger[k])[skin].float().mean()),
        "albedo_log": float((_centred(albedo) - _centred(known)).abs().mean()),
        "split_log": float((_centred(split) - _centred(known)).abs().mean()), **contrast_ratios(said, true, k),
        "shading": float(torch.corrcoef(torch.stack([(light - albedo).mean(0), (light - known).mean(0)]))[0, 1]),
        "within": float(within.float().mean()),
    }  # fmt: skip


def contrast_ratios(said: DensePrediction, true: DenseBatch, k: int) -> Row:
    """Contrast of the predicted albedo over that of the true one, in three bands, away from the end of the skin."""
    skin = true.skin[k]
    inner = inner_mask(skin.float(), RIM) > 0
    found, wanted = (
        contrasts([(split_bands(albedo.clamp_min(DARKEST).log().mean(0), skin.float()), inner)])
        for albedo in (_linear(said.albedo[k]), true.albedo[k])
    )
    if found is None or wanted is None:
        return {}
    ratios = [a / b for a, b in zip(found, wanted, strict=True)]
    return dict(zip(("contrast_1_2", "contrast_2_4", "contrast_4_8"), ratios[1:], strict=True))


def half_a_pixel_off(mask: Tensor) -> list[Tensor]:
    """A soft mask moved by half a pixel along one axis and along the other, cut at a half."""
    return [(mask + mask.roll(1, axis)) / 2 > 0.5 for axis in (0, 1)]


def _centred(logarithms: Tensor) -> Tensor:
    return logarithms - logarithms.mean(1, keepdim=True)


def _linear(srgb: Tensor) -> Tensor:
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


@torch.inference_mode()
def measure_person(network: DenseNetwork, options: Options, number: int) -> list[Row]:
    """Rows of one rendering: two people, with landmarks as a detector finds them, and without."""
    photos = DensePhotos(seed=options.seed, people=options.people, hands=2, size=256, device=torch.device("cpu"))
    scene, random = SceneConfig(people=options.people), torch.Generator().manual_seed(number)
    table = sample_table(options.seed, photos.photo_indices(number), scene)
    true = render_dense(options.seed, table, photos.size, "cpu", scene=scene, random=random)
    found = detected(true.landmarks, random)
    rows = []
    for known, landmarks in ((True, found), (False, torch.full_like(found, torch.nan))):
        said = network(true.image, landmarks)
        for k, person in enumerate(table.whole[:, 1]):
            row = errors(said, true, k)
            if row is not None:
                melanin = cached_identity(options.seed, int(person), scene.population).melanin
                rows.append({**row, "landmarks": known, "melanin": melanin})
    return rows


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    with resources.as_file(asset("estimator", "dense.safetensors")) as bundled:
        network = load_dense_network(options.weights or bundled)
    numbers = range(options.people * PHOTOS_EACH // 2)
    cases = {f"rendering {number}": (network, options, number) for number in numbers}
    return measured("dense_network", cases, measure_person, options)


def held_out(rows: list[Row]) -> str | None:
    """The table of all photos with landmarks, and how true the confidence is."""
    own = [row for row in rows if row["landmarks"]]
    made, share = distribution(own, MEASURES, "256 px"), mean(row["within"] for row in own)
    return made and (
        f"{made}\n\n{len(own)} photos. Of the surface coordinates, {share:.1%} lie within the {CLAIMED:.0%} claimed."
    )


def by_landmarks(rows: list[Row]) -> str | None:
    """Medians with landmarks and without."""
    return side_by_side({
        "landmarks as a detector finds them": [row for row in rows if row["landmarks"]],
        "none": [row for row in rows if not row["landmarks"]],
    })


def by_skin(rows: list[Row]) -> str | None:
    """Medians of the lightest, the middle and the darkest third."""
    own = sorted((row for row in rows if row["landmarks"]), key=lambda row: row["melanin"])
    names = ("lightest third", "middle", "darkest third")
    return side_by_side({name: own[k * len(own) // 3 : (k + 1) * len(own) // 3] for k, name in enumerate(names)})


def side_by_side(groups: dict[str, list[Row]]) -> str | None:
    """Medians of groups of rows, a column each."""
    if not all(groups.values()):
        return None
    lines = [
        [column.heading]
        + [column.text(percentiles(row.get(column.value) for row in rows)[1]) for rows in groups.values()]
        for column in MEASURES
    ]
    return markdown(["median", *groups], lines)


def file_table(rows: list[Row]) -> str:
    """What the bundled file is, and how it was trained."""
    with resources.as_file(asset("estimator", "dense.safetensors")) as path:
        header, content = read_dense_header(path), path.read_bytes()
    lines = {
        "file": f"`src/oasis_warp/assets/estimator/dense.safetensors`, {len(content) / 1e6:.2f} MB, half precision",
        "SHA-256": f"`{hashlib.sha256(content).hexdigest()}`",
        "channels, blocks": f"{header['widths']}, {header['depths']}",
        "training": header["notes"],
    }
    return markdown(["", ""], [[name, text] for name, text in lines.items()])


def draw(rows: list[Row], static: Path) -> None:
    """Draw photo with mask, classes, surface, confidence, normals, albedo and shading, a line for each photo."""
    lines = [np.concatenate(panels(photo_named(name)), 1) for name in SHOWN]
    write_jpeg(static / "dense_network.jpg", np.concatenate(lines, 0))


def panels(photo: Photo) -> list[np.ndarray]:
    """What the network says about the largest hand of a photo, as pictures of bytes."""
    found = choose_hand(estimator().find(photo), "largest", photo.name)
    rgb, xy = photo.rgb.numpy(), found.xy.double().numpy().copy()
    if found.side == "left":
        rgb, xy[:, 0] = np.ascontiguousarray(rgb[:, ::-1]), rgb.shape[1] - xy[:, 0]
    said = read_pixels(rgb, xy)
    on_hand = (said.hand > 0.5)[..., None]
    outline, _ = cv2.findContours((said.hand > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    marked = cv2.drawContours(said.image.copy(), outline, -1, (255, 0, 0), 1)
    confidence = np.clip((-3 - np.log(said.spread)) / 4, 0, 1)[..., None].repeat(3, 2)
    albedo = said.albedo.transpose(1, 2, 0)
    shading = (said.image / 255.0) ** GAMMA / np.maximum(albedo**GAMMA, DARKEST)
    fields = (
        said.shares[1:].transpose(1, 2, 0), (0.5 + 5 * said.surface.transpose(1, 2, 0)) * on_hand, confidence * on_hand,
        (0.5 + 0.5 * said.normal.transpose(1, 2, 0)) * on_hand, albedo * on_hand,
        (shading / 2) ** (1 / GAMMA) * on_hand,
    )  # fmt: skip
    return [marked, *((255 * field.clip(0, 1)).astype(np.uint8) for field in fields)]


SECTIONS = (
    Section("dense_network.md", "file", file_table), Section("dense_network.md", "held-out", held_out),
    Section("dense_network.md", "landmarks", by_landmarks), Section("dense_network.md", "skin", by_skin),
)  # fmt: skip
