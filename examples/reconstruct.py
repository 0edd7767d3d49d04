"""From one photo to a posed, rendered avatar in five calls.

    python examples/reconstruct.py
    python examples/reconstruct.py --photo my_hand.jpg --pose victory --out victory.png

Writes a picture of the avatar in another pose and its file beside it, and prints how closely it matches the photo.
"""

from dataclasses import dataclass
from importlib.resources import as_file
from pathlib import Path

import tyro

from oasis_warp import Avatar, read_photo, reconstruct
from oasis_warp.assets import asset
from oasis_warp.data.pictures import to_uint8, write_picture


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to turn into what."""

    photo: Path | None = None
    """A photo of a hand; the bundled one when not given."""
    pose: str = "fist"
    """One of oasis_warp.hand.poses.POSE_NAMES."""
    out: Path = Path("fist.png")
    """Picture to write."""


def main(options: Options) -> None:
    """Reconstruct, save, load, pose, draw."""
    with as_file(asset("photos", "palm_open_left_02.png")) as bundled:
        photo = read_photo(options.photo or bundled)
    made = reconstruct(photo)
    print(f"{photo.name}: {made.fit.side} hand, {made.errors['input_psnr_db']:.1f} dB to the photo")

    file = options.out.with_suffix(".safetensors")
    made.avatar.save(file)
    avatar = Avatar.load(file)  # from here on, neither photo nor network is needed

    pose = avatar.held(options.pose)
    camera = avatar.orbit_camera(pose, azimuth=0.5, size=512)
    write_picture(options.out, to_uint8(avatar.render(camera, pose).image))
    print(f"wrote {file} and {options.out}")


if __name__ == "__main__":
    main(tyro.cli(Options))
