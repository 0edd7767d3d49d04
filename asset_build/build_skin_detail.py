"""Make `assets/skin`: what is fine on real hands' skin, and where nails are, over the texture coordinates of the hand.

    python asset_build/build_skin_detail.py FOLDER

FOLDER holds the crops that `BOX` cuts from MakeHuman's body textures of 2048 px (CC0): the hand model was cut from the
same body and kept its texture coordinates, moved and scaled, so nothing needs to be registered. Three hands have detail
of their own and are taken; the light man's, on which several of the other textures are built, is left out to judge by.
"""

import hashlib
import sys
from pathlib import Path

import cv2
import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from oasis_warp.adaptation.inpainting import laplacian_and_mass
from oasis_warp.adaptation.skin_detail import BOX, FINER, GREY, LOUDEST_LINE, NO_LINE, UNIT, texels_of
from oasis_warp.adaptation.skin_forms import FORM_UNIT
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.wrist import shade_left
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import mesh_edges, smooth_over_mesh
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.atlas import bundled_atlas
from oasis_warp.synthetic.body import FINGERS, bundled_body
from oasis_warp.synthetic.identity import Population, sample_identity
from oasis_warp.synthetic.people import relief_forms
from oasis_warp.synthetic.skin_lines import Strokes, arc
from oasis_warp.synthetic.skin_plan import plan_skin
from oasis_warp.synthetic.skin_texture import nail_maps
from oasis_warp.synthetic.texels import draw_lines, texels_on

HANDS = {
    "young_lightskinned_female_diffuse2": 1.4,
    "middleage_lightskinned_male_diffuse2": 1.4,
    "skin_male_african_middleage": 0.65,
}
"""With each the gain of its detail: folds of dark skin are darker than those of light skin. The first one's fingers are
smooth on the palm's side, with red pads in a frame of paint: there it takes the second one's detail."""
SMOOTH, ON_FINGERS = 0.008, 0.0045
"""Length l of the low-pass 1 / (1 + (k l)^4) that is taken off, on the palm and back and on fingers [m]: half of what
repeats every 50 mm and every 28 mm goes. Folds, vessels and red knuckles stay; the gloss along fingers goes."""
LOUDEST = 0.16
"""Logarithm that detail tends to."""
AROUND = 3
"""Harmonics of the angle about each bone of a finger that are taken off before: the light and dark sides of fingers
are light left in the photos."""
FINE, FINE_GAIN = 1.2, 2.5
"""Blur [texels of .45 mm] and the gain of what is finer: Gaussians blur it again when they are drawn."""
DARKER, COLOUR = (0.82, 1.06, 1.12), 0.3
"""How much each channel's logarithm changes in the shade of a fold, the colour of all that is fine but for a share: the
maps' own is that of blocks of JPEG."""
SOFT, WIDEST_ON_PALM, EVEN_REACH = 0.6, 2.5, 9.0
"""Blurs [texels] of palms, of what is taken off them, and over which contrast is measured. What is wider than 2 mm on
the pictures' palms are blotches."""
PALM_CONTRAST, FLAT, PALM_LOUDEST, EVENINGS = 0.04, 0.012, 0.08, 2
"""Root mean square of the logarithms of a palm's detail, contrast below which skin is left smoother, and what this
detail tends to; how often it is divided by its contrast and limited. Set by eye, as the blurs, on drawn hands."""
WIDE_ON_BACK, LESS_ON_BACK = 4.0, 0.6
"""Blur [texels] of what is wide on backs, 2 mm and on fingers 4, and how much of it is taken off: it is what light and
pigment of these three hands, and on others stains."""
ON_PADS = 0.7
"""Contrast of the palm's side of fingers over that of palms, by eye: with 1 fingers look mottled."""
RIM = 3.0
"""Width of the islands' rims over which detail fades in: what lies beside them bled into them [texels]."""
PEOPLE = (19, 43)
"""People of the synthetic world whose palm's lines are taken, and the first one's veins. The photos' own lines are
blurred. Chosen by eye among 46 people, for long and soft lines."""
FOLDS, FOLDS_OF_THUMB = {1: (6, 5.2, 1.5), 2: (3, 2.3, 1.1)}, {2: (5, 4.5, 0.7)}
"""Number of folds over a finger's middle and end joint, how far from it they lie [mm], and their greatest strength. The
thumb's middle joint has none: they looked like a scab there. With 6.4 mm the outermost lay beyond the skin that
`avatar.folds` opens, and stayed as brown spots on bent fingers."""
FOLD_ANGLE, FOLD_BOW = 1.4, -1.6
"""Half of what the longest fold covers around the finger [rad], and how far the ends of the outermost ones bend back
towards the joint [mm/rad^2]. With .95 folds were short strokes, like scratches."""
PALM_LINES = {"crease": 2.2, "main": 1.4, "minor": 1.3, "wrinkle": 0.6}
"""How dark lines of the palm are, in units of a clear fold. With the wrinkles of older people as well, the ball of the
thumb had a dark patch."""
OLDER = (12, 26)
"""Older people whose fine lines cross the palms of these two besides their own: with few, palms were smooth rubber
between bold lines."""
RIDGE = 8.0
"""Blur of folds that is taken off [finer texels of .3 mm]: skin beside them is a ridge, which catches light. Without, a
joint was a brown patch."""
CORE, FLANK, FLANK_WIDTH = (1.6, 0.5), 0.1, (6.0, 4.2)
"""Gain of the palm's lines, gain of the same lines blurred, and this blur [finer texels: .15 mm on palms, .3 mm on
fingers]; two values are those of palms and of the palm's side of fingers. Skin rounds into a crease. On 10 photos of
tests/data/photos and its same_hand a finger's crease, averaged along it at 256 px, is .08 deep in log(sRGB) at the
middle joint, .09 at the end joint, and 3 to 4 mm wide. Lines between bright ridges were .10 and .14 deep and 1.5 mm
wide, like drawn rings. Blurred as far as these means are, creases were painted bands: a real one is several thin
lines."""
HEEL, AT_HEEL = (-0.075, -0.025), 0.3
"""Places along the hand [m] between which lines of the palm fade, and what is left of them at its heel: the line around
the ball of the thumb was a slit in a fist."""
BELOW_SKIN = 2.5
"""Blur of veins, which shine through the skin [finer texels]."""
PAD_RIM = 3.0
"""Blur of the border between fingers and palm [texels]."""
AROUND_PASSES = 20
"""Smoothings over the mesh that leave the skin around, some 10 mm: half of what a knuckle of 17 mm stands out stays."""
NAIL_LENGTH = 1.0
"""Free edge of the nails [mm]: one Gaussian of painted skin."""
NAIL_REACH = 1.0
"""Share of the nail's label from which on a texture's own nail is left out."""
DARKEST = 0.02
"""Of sRGB: below it the logarithm is noise."""


def main(folder: Path) -> None:
    """Read the crops, write the maps beside the other assets."""
    target = Path(__file__).parents[1] / "src/oasis_warp/assets/skin"
    hand = bundled_hand()
    corners = texels_of(hand.to(dtype=torch.float64)).numpy()[hand.uv_faces.numpy()]
    faces, places = rasterize(corners, BOX[3], BOX[2])
    details = []
    for name, gain in HANDS.items():
        bgr = cv2.imread(str(folder / f"{name}.png"))
        if bgr is None:
            raise FileNotFoundError(f"{folder / name}.png: expected a picture; give the folder of the crops.")
        picture = bgr[..., ::-1] / 255
        detail = band_pass(hand, np.log(np.maximum(picture, DARKEST)), faces, places)
        details.append(even_palm(hand, gain * detail, faces, places))
    share = finger_pads(hand, faces, places)[..., None]
    details[0] = details[0] + share * (details[1] - details[0])
    for k, detail in enumerate(details):
        stored = np.rint(GREY + UNIT * LOUDEST * np.tanh(detail / LOUDEST)).clip(0, 255).astype(np.uint8)
        write(target / f"detail_{k}.png", spread_out(stored, faces >= 0))
    faces, places = rasterize(FINER * corners, FINER * BOX[3], FINER * BOX[2])
    write(target / "nails.png", spread_out(nails(hand, faces, places), faces >= 0))
    write(target / "lines.png", spread_out(lines(hand, faces, places), faces >= 0, fill=NO_LINE))
    write_relief(hand, target / "relief.npz")
    maps = sorted([*target.glob("*.png"), *target.glob("*.npz")])
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in maps]
    (target / "SHA256").write_text("\n".join(sums) + "\n")


def lines(hand: HandModel, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The drawn lines of two persons and one person's veins, [H, W, 3]."""
    drawn = map(knuckle_folds, PEOPLE), map(lines_on_palm, PEOPLE, OLDER)
    folds, palms = (resampled(torch.stack(list(of_people), 1), faces, places) for of_people in drawn)
    read = folds - mean_around(folds, faces >= 0, RIDGE)
    pads, heel = finger_pads(hand, faces, places, FINER)[..., None], at_heel(hand, faces, places)[..., None]
    palms *= 1 - (1 - pads) * (1 - AT_HEEL) * heel
    for share, core, width in zip((1 - pads, pads), CORE, FLANK_WIDTH, strict=True):
        read += share * (core * palms + FLANK * mean_around(palms, faces >= 0, width))
    deep = mean_around(resampled(veins()[:, None], faces, places), faces >= 0, BELOW_SKIN)
    read = np.concatenate([read, deep], 2)
    before_wrist = shade_left(hand, hand.template)[:, 0]  # Gaussians stay coarse there, and thin lines would be dots
    read *= on_texels(before_wrist, hand, faces, places)[..., None]
    return np.rint(np.clip(NO_LINE + (255 - NO_LINE) / LOUDEST_LINE * read, 0, 255)).astype(np.uint8)


def at_heel(hand: HandModel, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """0 where the palm's lines are clear, 1 at its heel, [H, W]."""
    begins, ends = HEEL
    return on_texels(((hand.template[:, 0] - begins) / (ends - begins)).clamp(0, 1), hand, faces, places)


def write_relief(hand: HandModel, path: Path) -> None:
    """The heights of the synthetic world's forms above the skin around them, for each vertex."""
    heights, edges = torch.from_numpy(relief_forms()).float(), mesh_edges(hand.faces)
    stands_out = heights - smooth_over_mesh(heights, edges, AROUND_PASSES)
    np.savez_compressed(path, forms=np.rint(stands_out.T.numpy() / FORM_UNIT).clip(-127, 127).astype(np.int8))
    print(path.name, path.stat().st_size)


def write(path: Path, rgb: np.ndarray) -> None:
    """A PNG, as small as it gets."""
    cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(path.name, path.stat().st_size)


def rasterize(corners: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Face of each texel, -1 for none, [H, W], and its barycentrics there, [H, W, 3]."""
    faces, places = np.full((height, width), -1), np.zeros((height, width, 3))
    for face, points in enumerate(corners):
        low = np.maximum(np.floor(points.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(points.max(0)).astype(int) + 1, (width, height))
        column, row = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        system = np.concatenate([points.T, np.ones((1, 3))])
        target = np.stack([column.ravel() + 0.5, row.ravel() + 0.5, np.ones(column.size)])
        weight = (
            np.linalg.solve(system, target).T if abs(np.linalg.det(system)) > 1e-9 else np.full((column.size, 3), -1)
        )
        inside = (weight >= -1e-6).all(1)
        faces[row.ravel()[inside], column.ravel()[inside]] = face
        places[row.ravel()[inside], column.ravel()[inside]] = weight[inside]
    return faces, places


def band_pass(hand: HandModel, texture: np.ndarray, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The texture, logarithms, without what is smooth along the skin."""
    on, corners = faces >= 0, hand.faces.numpy()[np.maximum(faces, 0)]
    n_vertices = len(hand.template)
    laplacian, mass = laplacian_and_mass(hand.template.double().numpy(), hand.faces.numpy())
    weight = places[on].ravel()
    count = np.bincount(corners[on].ravel(), weight, n_vertices)
    at_vertices = np.stack([
        np.bincount(corners[on].ravel(), weight * np.repeat(texture[on][:, c], 3), n_vertices) for c in range(3)
    ], 1) / np.maximum(count, 1e-9)[:, None]  # fmt: skip
    around = light_around_bones(hand, at_vertices)
    at_vertices = at_vertices - around
    texture = texture - (around[corners] * places[..., None]).sum(2)
    known = mass * np.minimum(count, 1) * (hand.nail.numpy() < NAIL_REACH / 2)
    known = known * np.where(hand.segment.numpy() > 0, SMOOTH / ON_FINGERS, 1) ** 4
    bending = SMOOTH**4 * laplacian @ sparse.diags_array(1 / mass) @ laplacian
    smooth = splu((sparse.diags_array(known + 1e-9 * mass) + bending).tocsc()).solve(known[:, None] * at_vertices)
    detail = sharpened(np.where(on[..., None], texture - (smooth[corners] * places[..., None]).sum(2), 0), on)
    nail = (label_regions(hand).nail.double().numpy()[corners] * places).sum(2)
    inner = np.clip(cv2.distanceTransform(on.astype(np.uint8), cv2.DIST_L2, 5) / RIM, 0, 1)
    share = inner * (1 - np.clip(2 * nail / NAIL_REACH, 0, 1))
    return detail * share[..., None]


def sharpened(detail: np.ndarray, on: np.ndarray) -> np.ndarray:
    """The detail with more of what is fine, in the colour of shade."""
    coarse = mean_around(detail, on, FINE)
    fine = np.where(on[..., None], detail - coarse, 0)
    grey = fine.mean(2, keepdims=True)
    return np.where(on[..., None], coarse, 0) + FINE_GAIN * (grey * np.array(DARKER) + COLOUR * (fine - grey))


def mean_around(values: np.ndarray, on: np.ndarray, reach: float) -> np.ndarray:
    """Values blurred by a Gaussian of that standard deviation [texels], without those beside the hand, [H, W, C]."""
    weight = cv2.GaussianBlur(on.astype(np.float64), (0, 0), reach)
    total = cv2.GaussianBlur(values * on[..., None], (0, 0), reach).reshape(values.shape)  # one channel is dropped
    return total / np.maximum(weight, 1e-6)[..., None]


def even_palm(hand: HandModel, detail: np.ndarray, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Only what is fine in the detail of palms, with the same contrast everywhere; on backs less of what is wide.

    In the pictures, creases are dark bars, the widest of pigment on dark skin, and the paint that fills the sides of
    fingers frames them: on straightened fingers, rings and frames as of nails. Divided by its contrast around,
    all of a palm is skin; creases are drawn (`lines_on_palm`).
    """
    on = faces >= 0
    palm, pads = on_texels(label_regions(hand).palm, hand, faces, places), finger_pads(hand, faces, places)

    fine = mean_around(detail - mean_around(detail, on, WIDEST_ON_PALM), on, SOFT)
    for _ in range(EVENINGS):
        contrast = np.sqrt(mean_around(np.square(fine), on, EVEN_REACH).mean(2, keepdims=True))
        fine = PALM_CONTRAST * fine / np.hypot(contrast, FLAT)
        fine = PALM_LOUDEST * np.tanh(fine / PALM_LOUDEST)
    fine *= 1 - (1 - ON_PADS) * pads[..., None]
    detail = detail - LESS_ON_BACK * mean_around(detail, on, WIDE_ON_BACK)
    return np.where(on[..., None], detail + palm[..., None] * (fine - detail), 0)


def finger_pads(hand: HandModel, faces: np.ndarray, places: np.ndarray, finer: int = 1) -> np.ndarray:
    """Share of the palm's side of fingers in each texel, [H, W]; texels may be so many times finer."""
    finger = on_texels((hand.segment > 0).double(), hand, faces, places)
    return cv2.GaussianBlur(finger, (0, 0), finer * PAD_RIM) * on_texels(label_regions(hand).palm, hand, faces, places)


def on_texels(values: torch.Tensor, hand: HandModel, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values at the vertices, read at the texels, [H, W]; 0 beside the hand."""
    corners = hand.faces.numpy()[np.maximum(faces, 0)]
    return np.where(faces >= 0, (values.double().numpy()[corners] * places).sum(2), 0)


def light_around_bones(hand: HandModel, colors: np.ndarray) -> np.ndarray:
    """Least squares of the colours on the fingers by harmonics of the angle about each bone, without its mean."""
    fitted, theta = np.zeros_like(colors), hand.bone_theta.double().numpy()
    waves = [f(k * theta) for k in range(1, AROUND + 1) for f in (np.cos, np.sin)]
    basis = np.stack([np.ones_like(theta), *waves], 1)
    for bone in range(1, len(hand.parents)):
        here = (hand.segment == bone).numpy()
        skin = here & (hand.nail.numpy() < NAIL_REACH / 2)
        part = np.linalg.lstsq(basis[skin], colors[skin], rcond=None)[0]
        fitted[here] = basis[here, 1:] @ part[1:]
    laplacian, mass = laplacian_and_mass(hand.template.double().numpy(), hand.faces.numpy())
    return splu((sparse.diags_array(mass) + SMOOTH**2 * laplacian).tocsc()).solve(mass[:, None] * fitted)


def veins() -> torch.Tensor:
    """The veins of one person of the synthetic world, at its texels; none on the palm."""
    return lines_of(PEOPLE[0])["vein"] * (1 - palm_share())


def knuckle_folds(seed: int) -> torch.Tensor:
    """How dark the folds over the joints of fingers are, at the synthetic world's texels.

    Arcs around the middle of each joint, 2 mm apart. The world's own are 1.2 mm apart: Gaussians of 1 mm blur them
    into a stain.
    """
    atlas, strokes = bundled_atlas(), Strokes(np.random.default_rng([seed]))
    u = strokes.rng.uniform
    for finger, name in enumerate(FINGERS):
        for place, (count, reach, strength) in (FOLDS_OF_THUMB if name == "thumb" else FOLDS).items():
            bone = bundled_body().bones[finger][place]
            for t in np.linspace(-1, 1, count):
                half = FOLD_ANGLE * np.sqrt(1.15 - t**2) * u(0.75, 1.1)
                angles = strokes.rng.normal(0, 0.08) + np.linspace(-half, half, 16)
                at = reach * t + strokes.rng.normal(0, 0.25) - (place == 1)
                line = arc(atlas, name, bone, at, angles, 8.0, FOLD_BOW * t + strokes.rng.normal(0, 0.4))
                strokes.add("fold", line, u(0.4, 0.5), strength * u(0.7, 1.0), taper=0.3, wobble=0.35)
    return draw_lines(strokes.lines(), texels_on("cpu").grid)["fold"] * (1 - palm_share())


def lines_on_palm(number: int, older: int) -> torch.Tensor:
    """How dark the lines of one person's palm are, with fine lines of an older one, at its texels; 0 on the back."""
    own, other = lines_of(number), lines_of(older)
    own["minor"] = torch.maximum(own["minor"], other["minor"])
    return palm_share() * sum(gain * own[name] for name, gain in PALM_LINES.items())


def lines_of(number: int) -> dict[str, torch.Tensor]:
    """All lines of a person of the synthetic world, at its texels."""
    person = sample_identity(bundled_hand(), 0, number, Population(hair=0))
    return draw_lines(plan_skin(person).lines, texels_on("cpu").grid)


def palm_share() -> torch.Tensor:
    """The share of palm at the synthetic world's texels."""
    return ((texels_on("cpu").palm - 0.28) / 0.52).clamp(0, 1)


def resampled(values: torch.Tensor, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values at the synthetic world's texels, read over the texture coordinates of the hand, [H, W, C]."""
    body = bundled_body()
    maps = texels_on("cpu").image(values.half()).float()
    at_corners = body.uv[body.uv_faces[: body.n_hand_faces]].double().numpy()[np.maximum(faces, 0)]
    place = (at_corners * places[..., None]).sum(2)
    grid = torch.from_numpy(2 * place - 1).float()[None]
    read = torch.nn.functional.grid_sample(maps.permute(2, 0, 1)[None], grid, align_corners=False)
    return read[0].permute(1, 2, 0).numpy()


def nails(hand: HandModel, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Plate, lunula and free edge, and fold around the plate, of a person with short round nails, [H, W, 3]."""
    texels = texels_on("cpu")
    identity = sample_identity(hand, 0, 0, Population())._replace(nail_length=NAIL_LENGTH, nail_shape=2.6, lunula=0.5)
    own = nail_maps(texels, identity, np.zeros(5))
    read = resampled(torch.stack([own.plate, own.plate * (own.lunula - own.free), own.rim], 1), faces, places)
    corners = hand.faces.numpy()[np.maximum(faces, 0)]
    back = 1 - (label_regions(hand).palm.double().numpy()[corners] * places).sum(2)  # the painter's fold goes round
    values = read * back[..., None] * np.array([255, 127, 255]) + np.array([0, GREY, 0])
    return np.rint(np.clip(np.where((faces >= 0)[..., None], values, [0, GREY, 0]), 0, 255)).astype(np.uint8)


def spread_out(picture: np.ndarray, on: np.ndarray, fill: int = GREY) -> np.ndarray:
    """Every texel beside the islands takes the nearest one's value, so that sampling at their rims reads no gap."""
    _, nearest = cv2.distanceTransformWithLabels((~on).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    values = np.zeros((nearest.max() + 1, 3), np.uint8)
    values[nearest[on]] = picture[on]
    away = cv2.distanceTransform((~on).astype(np.uint8), cv2.DIST_L2, 5) > 4
    return np.where(away[..., None], np.uint8(fill), values[nearest])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
