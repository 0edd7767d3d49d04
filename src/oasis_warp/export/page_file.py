"""The page of an avatar: one HTML file that needs no network, put together from the files of the folder `page`."""

import base64
import hashlib
import html
from importlib import resources
from pathlib import Path

from oasis_warp import __version__
from oasis_warp.core.types import HandPose
from oasis_warp.data.output_files import write_file
from oasis_warp.export.page_data import pack_data, page_facts
from oasis_warp.export.request import ExportRequest
from oasis_warp.hand_avatar import Avatar

WORKER = (
    "data.js", "surface.js", "posing.js", "gaussians.js", "sky.js", "shading.js", "projection.js", "worker.js",
)  # fmt: skip
RASTER = ("raster.js",)
SCRIPT = ("graphics.js", "processor.js", "viewer.js", "gestures.js", "controls.js", "main.js")
"""Files of the page's two workers and of the page itself, in order."""


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


def page_html(avatar: Avatar, title: str, *, pose: HandPose | None = None, look: str = "photo") -> str:
    """The page of `avatar`: it poses, lights and draws the hand by the same rules as `Avatar.render`.

    Args:
        avatar: Any.
        title: Shown above the controls and by the browser.
        pose: Whose angles the page begins with; those of the photo when not given.
        look: "photo" or "even": light that it begins with.
    """
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
        "data": pack_data(*page_facts(avatar, None if pose is None else pose.angles, look)),
    }
    page = page_text("page.html")
    for name, text in parts.items():
        page = page.replace("{{" + name + "}}", text)
    return page


def write_page(request: ExportRequest, path: Path) -> None:
    """Write the page of an avatar.

    Raises:
        InputError: `path` cannot be written.
    """
    look = "even" if request.light == "none" else "photo"
    write_file(path, page_html(request.avatar, path.stem, pose=request.pose, look=look).encode())
