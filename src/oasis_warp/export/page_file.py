"""The page of an avatar: one HTML file that needs no network, of the files of the folder `page` and packed numbers."""

import base64
import hashlib
import html
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from oasis_warp import __version__
from oasis_warp.core.types import Gaussians, HandPose, Photo
from oasis_warp.data.output_files import write_file
from oasis_warp.export.page_data import Packed, pack_data, page_facts, splat_facts
from oasis_warp.export.request import ExportRequest
from oasis_warp.hand_avatar import Avatar

WORKER = (
    "data.js", "surface.js", "contact.js", "posing.js", "gaussians.js", "sky.js", "shading.js", "projection.js",
    "splats.js", "worker.js",
)  # fmt: skip
RASTER = ("raster.js",)
SCRIPT = ("graphics.js", "processor.js", "viewer.js", "gestures.js", "controls.js", "main.js")
"""Files of the page's two workers and of the page itself, in order."""
PHOTO_SIDE = 1024
"""Longer side of the photo beside the hand [px]."""


def page_text(name: str) -> str:
    """A file of the folder `page`."""
    return (resources.files("oasis_warp.export") / "page" / name).read_text(encoding="utf-8")


def page_policy(style: str, script: str) -> str:
    """Content security policy: nothing is fetched, and only this style, this script and its worker run."""
    style_hash, script_hash = (
        base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)
    )
    return (
        f"default-src 'none'; script-src 'sha256-{script_hash}'; style-src 'sha256-{style_hash}'; worker-src blob:; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def page_html(
    avatar: Avatar, title: str, *, pose: HandPose | None = None, look: str = "photo", photo: Photo | None = None
) -> str:
    """The page of `avatar`: it poses, lights and draws the hand by the same rules as `Avatar.render`.

    Args:
        avatar: Any.
        title: Shown above the controls and by the browser.
        pose: The pose that the page begins with; that of the photo when not given.
        look: "photo" or "even": light that it begins with.
        photo: Shown beside the hand.
    """
    return _page(title, *page_facts(avatar, None if pose is None else pose.angles, look), photo)


def splats_html(gaussians: Gaussians, title: str, *, photo: Photo | None = None) -> str:
    """The page of Gaussians of another program: it turns and draws them, and cannot pose them."""
    return _page(title, *splat_facts(gaussians), photo)


def _page(title: str, facts: dict[str, Any], arrays: dict[str, np.ndarray | Packed], photo: Photo | None) -> str:
    style = page_text("page.css")
    worker, raster, script = ("\n".join(page_text(name) for name in names) for names in (WORKER, RASTER, SCRIPT))
    parts = {
        "version": __version__,
        "policy": html.escape(page_policy(style, script)),
        "title": html.escape(title),
        "style": style,
        "worker": worker,
        "raster": raster,
        "script": script,
        "photo": "" if photo is None else _photo_tag(photo),
        "data": pack_data(facts, arrays),
    }
    page = page_text("page.html")
    for name, text in parts.items():
        page = page.replace("{{" + name + "}}", text)
    return page


def _photo_tag(photo: Photo) -> str:
    height, width = photo.rgb.shape[:2]
    share = min(1.0, PHOTO_SIDE / max(width, height))
    size = max(1, round(width * share)), max(1, round(height * share))
    pixels = cv2.resize(photo.rgb.numpy()[..., ::-1], size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", pixels)
    return f'<img id="photo" alt="The photo" src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}">'


def write_page(request: ExportRequest, path: Path) -> None:
    """Write the page of an avatar.

    Raises:
        InputError: `path` cannot be written.
    """
    look = "even" if request.light == "none" else "photo"
    write_file(path, page_html(request.avatar, path.stem, pose=request.pose, look=look, photo=request.photo).encode())
