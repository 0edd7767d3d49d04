"""Draw an avatar with gsplat: `avatar.pose` returns gsplat's arguments in gsplat's order.

    python examples/draw_with_gsplat.py --avatar out/avatar.safetensors

Draws with oasis_warp, which needs no GPU, and with gsplat if it is installed, and prints the largest difference.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from oasis_warp import Avatar, rasterization


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to draw."""

    avatar: Path
    """Avatar file of `oasis reconstruct`."""
    pose: str = "fist"
    device: str = "cpu"
    """gsplat needs cuda."""


def main(options: Options) -> None:
    """Pose once, draw with both."""
    avatar = Avatar.load(options.avatar, options.device)
    camera, gaussians = avatar.source_camera, avatar.pose(options.pose)  # means, quats, scales, opacities, colors
    view = {"viewmats": camera.viewmat[None], "Ks": camera.K[None], "width": camera.width, "height": camera.height}
    ours, alphas, _ = rasterization(*gaussians, **view)
    print(f"{len(gaussians.means)} Gaussians cover {float(alphas.mean()):.1%} of the picture")
    try:
        import gsplat
    except ImportError:
        return
    theirs, _, _ = gsplat.rasterization(*gaussians, **view)
    print(f"gsplat differs by {float((ours - theirs).abs().max()):.1e} at most")


if __name__ == "__main__":
    main(tyro.cli(Options))
