"""What finer Gaussians are worth: error, size and time against the side of the crop, and a picture of it.

    python studies/evaluate_detail.py --out out/detail
    python studies/evaluate_detail.py --out out/detail --sheet docs/_static/detail.jpg

Writes detail.json and prints the table of docs/detail.md. Every photo is made into an avatar with each --size; its
pictures are compared with the photo in a crop as large as the photo's own and in one of 256 px, away from outlines and
above the wrist. "synthetic:K" is person K of the held-out synthetic hands, photographed in even light on 1280 px:
of real photos there are none so large among the tests. Frame times are those of one picture of 512 px, over that of the
avatar of 256 px.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from named_photos import SYNTHETIC, photo_of
from torch import Tensor

from oasis_warp.avatar.observation import inner_mask
from oasis_warp.cli.summary import Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera, project
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera, HandCrop
from oasis_warp.data.output_files import write_file
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import CROP_MARGIN, Reconstruction, crop_hand, detail_size, reconstruct

PHOTOS = (
    "synthetic:2", "synthetic:7", "back_flat_right_04.jpg", "palm_open_left_02.png", "small_pointing_right_13.jpg"
)  # fmt: skip
SIZES = (64, 128, 256, 512, 1024)
PLAIN, FAR = 256, 256
"""Sides of the crop that the others are compared with, and of the picture from afar [px]."""
SYNTHETIC_SIZE, FRAME_SIZE, FRAMES = 1280, 512, 9
RIM = 1 / 64
"""Share of the crop's side, at the outline, that is not judged."""
CLOSE = (
    ("synthetic:2", 12, "nail"), ("synthetic:7", 10, "creases"), ("back_flat_right_04.jpg", 10, "knuckle"),
    ("back_flat_right_04.jpg", 12, "nail"),
)  # fmt: skip
"""Photo, landmark in the middle and name of each row of the sheet."""
CLOSE_SHARE, SHEET_WIDTH, QUALITY = 0.17, 1000, 90
TURNED = 0.7
"""The last panel of a row is turned by so much [rad]: the finer part must not show its border."""


def place(name: str, folder: Path) -> str:
    """Where a photo of the tests lies; a synthetic one lies nowhere."""
    return name if name.startswith(SYNTHETIC) else str(folder / name)


@torch.no_grad()
def draw(avatar: Avatar, crop: HandCrop) -> Float[Tensor, "S S 3"]:
    """The avatar over black as `crop` shows the hand, a left hand mirrored."""
    left = avatar.side == "left"
    camera = mirror_camera(crop.camera) if left else crop.camera
    image = avatar.render(camera, avatar.source_pose, BLACK).image
    return image.flip(1) if left else image


def error(made: Reconstruction, crop: HandCrop) -> float:
    """PSNR against the photo, away from the wrist and from outlines of mask and surface [dB].

    Between fingers that touch in the photo the surface may have a gap, which no Gaussian fills.
    """
    camera, faces = crop.camera, made.avatar.hand.faces
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    hand = crop.mask * (seen.face_ids >= 0)
    inside = inner_mask(hand, max(1, round(RIM * len(hand)))) * crop.above_wrist
    return masked_psnr(draw(made.avatar, crop), crop.image, (inside > 0.5).float())


def file_bytes(avatar: Avatar) -> int:
    """Of the avatar's file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.safetensors"
        avatar.save(path)
        return path.stat().st_size


@torch.no_grad()
def frame_times(avatars: list[Avatar]) -> list[float]:
    """Fewest milliseconds of posing and drawing each avatar once, in turns."""
    best = [float("inf")] * len(avatars)
    for _ in range(FRAMES):
        for k, avatar in enumerate(avatars):
            camera = crop_camera(avatar.source_camera, 0.0, 0.0, float(avatar.source_camera.width), FRAME_SIZE)
            start = time.perf_counter()
            avatar.render(camera, avatar.source_pose).image.sum().item()  # waits for a GPU
            best[k] = min(best[k], 1e3 * (time.perf_counter() - start))
    return best


def measure(name: str, folder: Path, config: ReconstructConfig) -> list[dict[str, object]]:
    """A row for each size."""
    photo, made = photo_of(place(name, folder), SYNTHETIC_SIZE, config.device), {}
    for size in SIZES:
        made[size] = reconstruct(photo, ReconstructConfig(**{**vars(config), "size": size, "force": True}))
    first = made[PLAIN]
    whole = detail_size(first.fit, config)
    close, far = (
        crop_hand(photo, first.fit, first.avatar.surface_offsets.cpu(), config, size) for size in (whole, FAR)
    )
    times = frame_times([each.avatar for each in made.values()])
    return [
        {
            "photo": name,
            "native_size": whole,
            "size": size,
            "psnr_db": error(each, close),
            "psnr_far_db": error(each, far),
            "gaussians": len(each.avatar.gaussians.opacities),
            "bytes": file_bytes(each.avatar),
            "frame": frame / times[SIZES.index(PLAIN)],
            "detail_s": each.stages.get("detail", 0.0),
            "total_s": sum(each.stages.values()),
        }
        for (size, each), frame in zip(made.items(), times, strict=True)
    ]


COLUMNS = (
    "photo", "its own side, px", "size", "PSNR at its own side, dB", "at 256 px, dB", "Gaussians", "file, MB",
    "frame, of that at 256", "detail, s", "in all, s",
)  # fmt: skip


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    lines += [
        f"| {Path(row['photo']).stem} | {row['native_size']} | {row['size']} | {row['psnr_db']:.1f} | "
        f"{row['psnr_far_db']:.1f} | {row['gaussians']} | {row['bytes'] / 1e6:.1f} | {row['frame']:.2f} | "
        f"{row['detail_s']:.1f} | {row['total_s']:.0f} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def sheet(folder: Path, config: ReconstructConfig, path: Path) -> None:
    """Photo, avatar of 256 px and of the photo's own size, and the latter from the side, around some landmarks."""
    rows, known, pixels = [], {}, panel_side(4, SHEET_WIDTH)
    for name, landmark, words in CLOSE:
        if name not in known:
            photo = photo_of(place(name, folder), SYNTHETIC_SIZE, config.device)
            both = [reconstruct(photo, ReconstructConfig(**{**vars(config), "size": s})) for s in (PLAIN, "auto")]
            known[name] = photo, *both
        photo, plain, fine = known[name]
        fit, size = fine.fit, detail_size(fine.fit, config)
        _, _, side = square_around(fit.mask, CROP_MARGIN)
        xy, side = fit.landmarks.xy[landmark], CLOSE_SHARE * side
        square = float(xy[0]) - side / 2, float(xy[1]) - side / 2, side
        camera = crop_camera(fit.camera, *square, pixels)
        shown = to_uint8(resample_square(photo.rgb.float() / 255, *square, pixels)).numpy()
        panels = [Panel(shown, f"{words}: photo, {size} px")]
        beside = _beside(fine, xy, camera)
        for made, seen, caption in (
            (plain, camera, "avatar, 256 px"), (fine, camera, f"avatar, {size} px"), (fine, beside, "from beside"),
        ):  # fmt: skip
            panels.append(Panel(to_uint8(made.avatar.render(seen, fit.pose).image).cpu().numpy(), caption))
        rows.append(panels)
    picture = make_sheet("Detail", "before and after, and from beside", rows, SHEET_WIDTH)
    _, data = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    write_file(path, np.asarray(data).tobytes())


def _beside(made: Reconstruction, xy: Tensor, camera: Camera) -> Camera:
    """`camera`, turned by `TURNED` about the place of the surface that the photo shows at `xy` [px]."""
    vertices = made.avatar.mesh(made.fit.pose).vertices.cpu()
    uv, _ = project(made.fit.camera, vertices)
    hidden = made.quality.visibility.cpu() == 0
    middle = vertices[((uv - xy).norm(dim=1) + 1e6 * hidden).argmin()]
    turn = from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(TURNED))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, middle - turn @ middle
    return camera._replace(viewmat=viewmat @ camera.viewmat.cpu())


def main() -> None:
    """Measure, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=Path("tests/data/photos"))
    parser.add_argument("--names", nargs="+", default=PHOTOS, help="of photos in that folder, or synthetic:K")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--prior", default="learned", help="learned, none or a weights file")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sheet", type=Path, help="JPEG to draw, instead of the table")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    prior = options.prior if options.prior in ("learned", "none") else Path(options.prior)
    config = ReconstructConfig(prior=prior, device=options.device)
    if options.sheet:
        return sheet(options.photos, config, options.sheet)
    rows = [row for name in options.names for row in measure(name, options.photos, config)]
    write_file(options.out / "detail.json", json.dumps(rows, indent=1).encode())
    print(table(rows))
    return None


if __name__ == "__main__":
    main()
