"""How dark skin is in hollows of real hands, by the share of the sky that the fitted hand leaves it.

Fills docs/avatar.md (hollows).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.observation import Observation, observe
from oasis_warp.avatar.sky import arriving, harmonic_basis
from oasis_warp.avatar.vertex_light import GAMMA, posed_lighting
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandCrop, HandLight, PosedHand
from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation import views
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import reconstruct
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import PHOTOS, photos_below
from studies.tables import Column, Section, complete, table

EDGES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.01)
"""Of the bins of the share of the sky. Skin that is seen and sees less lies where the fit is wrong."""
OPEN, FEWEST = 0.8, 300
"""Share of the sky from which skin counts as open, and fewest such vertices of a photo."""
SURE = 0.8
"""Least confidence of a vertex's colour."""
CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    photos: Path = PHOTOS / "same_hand"
    """Folder of photos; those of left hands are left out."""


class SeenSkin(NamedTuple):
    """What the picture of a right hand shows from its photo's camera, and the light on it."""

    avatar: Avatar
    light: HandLight
    albedo: Float[Tensor, "3"]
    """Of `light`."""
    posed: PosedHand
    seen: Observation
    normals: Float[Tensor, "V 3"]
    exposure: Float[Tensor, "V 4"]
    """As `sky.exposure`."""


def seen_skin(path: Path, config: ReconstructConfig) -> SeenSkin | None:
    """The skin that a photo shows; None of a left hand."""
    avatar = reconstruct(read_photo(path), config).avatar
    light = avatar.light
    if avatar.side == "left" or light is None or light.albedo is None:
        return None
    photo = views.views_of(avatar)[0]
    drawn, posed, faces = views.draw(avatar, photo), avatar.mesh(photo.pose), avatar.hand.faces
    above = torch.ones_like(drawn.alpha.squeeze(-1))
    crop = HandCrop(drawn.image.clamp(0, 1), drawn.alpha.squeeze(-1), above, photo.camera, avatar.rest, posed)
    seen, on = observe(avatar.hand, crop), posed_lighting(avatar.rest.vertices, posed.vertices, faces, light)
    assert on.exposure is not None, "there is an albedo"
    return SeenSkin(avatar, light, light.albedo, posed, seen, on.normals, on.exposure)


def measure_photo(path: Path, options: Options) -> list[Row]:
    """A row for each bin of the share of the sky: how bright skin is beyond the light, over that of open skin."""
    found = seen_skin(path, options.config())
    if found is None:
        return []
    avatar, light, albedo, _, seen, normals, exposure = found
    least, most = light.limits.unbind(0)
    received = harmonic_basis(normals, len(light.harmonics)) @ light.harmonics
    beyond = (seen.colors.clamp_min(1e-3) ** GAMMA / torch.minimum(torch.maximum(received, least), most)).log()
    good = (seen.confidence > SURE) & (avatar.hand.nail < 0.1)
    sky, beyond = exposure[good, 0], beyond[good]
    if int((sky > OPEN).sum()) < FEWEST:
        return []
    beyond = beyond - beyond[sky > OPEN].median(0).values
    bins, rows = torch.bucketize(sky, torch.tensor(EDGES)) - 1, []
    for k in range(len(EDGES) - 1):
        inside = bins == k
        if bool(inside.any()):
            logarithms = beyond[inside].median(0).values.tolist()
            rows.append({"bin": k, "vertices": int(inside.sum()), "sky": float(sky[inside].mean()),
                         "beyond": logarithms, "albedo": albedo.tolist()})  # fmt: skip
    return rows


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    cases = {path.relative_to(options.photos).as_posix(): (path, options) for path in photos_below(options.photos)}
    return measured("hollows", cases, measure_photo, options)


def shares(rows: list[Row]) -> list[Row]:
    """Means over photos of their medians, weighted by vertices, beside what `arriving` gives at the mean albedo."""
    own = complete(rows)
    if not own:
        return []
    albedo = torch.tensor(np.mean([row["albedo"] for row in own], 0), dtype=torch.float32)
    bins = [[row for row in own if row["bin"] == k] for k in range(len(EDGES) - 1)]
    sizes = [np.array([row["vertices"] for row in rows_of]) for rows_of in bins]
    sky = [float(np.average([r["sky"] for r in rows_of], weights=n)) for rows_of, n in zip(bins, sizes, strict=True)]
    model = arriving(torch.tensor(sky)[:, None].expand(-1, 3), albedo)
    model = model / model[-2]  # as bright as skin at the lower end of what counts as open
    photos = np.array([
        np.average([r["beyond"] for r in rows_of], axis=0, weights=n) for rows_of, n in zip(bins, sizes, strict=True)
    ])  # fmt: skip
    photos = np.exp(photos - photos[-2])
    return [
        {
            "sky": f"{low:.1f} to {min(high, 1):.1f}", "vertices": int(n.sum()),
            **dict(zip(CHANNELS, seen.tolist(), strict=True)),
            **{f"model_{name}": float(value) for name, value in zip(CHANNELS, modelled, strict=True)},
        }
        for low, high, n, seen, modelled in zip(EDGES, EDGES[1:], sizes, photos, model, strict=False)
    ]  # fmt: skip


SECTIONS = (
    Section("avatar.md", "hollows", table(
        (
            Column("share of the sky", "sky"), Column("vertices", "vertices", ",d"),
            *(Column(f"photos, {name}", name, ".2f") for name in CHANNELS),
            *(Column(f"model, {name}", f"model_{name}", ".2f") for name in CHANNELS),
        ),
        shares,
    )),
)  # fmt: skip
