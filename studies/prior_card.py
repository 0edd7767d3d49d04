"""What the prior that ships is: its file, its training, and what its Gaussians are like on synthetic photos.

Fills docs/prior.md (file, training, gaussians).
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import torch

from oasis_warp.assets import asset
from oasis_warp.avatar.anchors import INSET
from oasis_warp.avatar.observation import CropBatch, source_photos
from oasis_warp.core import surface
from oasis_warp.evaluation.held_out import CaptureConfig, capture_person, estimated_batch
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import BUNDLED
from oasis_warp.network.weights_file import load_network, read_header
from studies.harness import Row, StudyOptions, write_rows
from studies.inputs import people
from studies.tables import markdown, section_of

QUANTILES = (0.1, 0.5, 0.9)
RETRAIN = ("steps", "hands", "views", "people", "size", "seed", "precision", "profile")
"""Options of `oasis pretrain` by their names in the notes."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    people: int = 8
    """Synthetic photos, each of another person."""


def file_table(path: Path) -> str:
    """What the weights file is."""
    header = read_header(path)
    config = header["config"]
    rows = {
        "file": f"`src/oasis_warp/assets/{'/'.join(BUNDLED)}`, {path.stat().st_size / 1e6:.1f} MB, half precision",
        "SHA-256": f"`{hashlib.sha256(path.read_bytes()).hexdigest()}`",
        "hand model": f"{header['hand_model']}: {header['n_vertices']:,} vertices, {header['n_faces']:,} faces",
        "network": f"profile `{config['profile']}`, {config['width']} channels, {config['n_tokens']} tokens, "
                   f"{config['refine_layers']} blocks over {config['n_coarse']:,} points",
        "photo": f"{config['image_size']} px",
        "written by": header["creator"],
    }  # fmt: skip
    return markdown(["", ""], [[name, text] for name, text in rows.items()])


def training_text(path: Path) -> str:
    """How it was trained, and the command that does so again."""
    notes = json.loads(read_header(path)["notes"])
    flat = {name: value for name, value in notes.items() if not isinstance(value, dict)}
    lines = [[name.replace("_", " "), shown(value)] for name, value in flat.items()]
    losses = ", ".join(f"{name.replace('_', ' ')} {shown(value)}" for name, value in notes.get("losses", {}).items())
    if losses:
        lines.append(["losses", losses])
    options = [f"--{name} {notes[name]}" for name in RETRAIN if name in notes]
    if notes.get("start_sha256"):
        options.append("--initial-weights START.safetensors")  # the weights of that SHA-256
    if notes.get("hold_out"):
        options.append("--hold-out " + " ".join(notes["hold_out"]))
    command = f"```sh\noasis pretrain prior {' '.join(options).replace('bfloat16', 'bf16')}\n```"
    return markdown(["setting", "value"], lines) + "\n\nThe same again:\n\n" + command


def shown(value: object) -> str:
    """A setting, for people."""
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def estimated_photos(count: int) -> Iterator[CropBatch]:
    """A synthetic photo of each of so many people."""
    capture = CaptureConfig(targets=1)
    for number in people(count):
        person = capture_person(capture, "ordinary", number, torch.device("cpu"))
        yield source_photos(estimated_batch(bundled_hand(), person, "wild", capture, 1.0))


@torch.no_grad()
def gaussian_table(network: HandNetwork, photos: Iterable[CropBatch]) -> str:
    """What the Gaussians of the guess are like: quantiles over those of photos of one hand each.

    The distance under the skin is along its normal. A face's Gaussian may leave the middle of its face, and the face's
    features need not be the mean of its corners' (the paper's Feature-on-Mesh, equation 7).
    """
    hand = bundled_hand()
    found: dict[str, list[torch.Tensor]] = {}

    def add(kind: str, values: dict[str, torch.Tensor]) -> None:
        for name, each in values.items():
            found.setdefault(f"{kind}: {name}", []).append(each)

    for batch in photos:
        guess, rest = network(batch), batch.rest[0]
        n = guess.offsets.shape[1]
        deep = INSET - (guess.offsets[0] * surface.vertex_normals(rest, hand.faces)).sum(-1)
        shapes = _shapes(guess.opacities[0, :n], guess.scales[0, :n])
        add("on vertices", {**shapes, "under the skin, mm": 1e3 * deep})
        if guess.opacities.shape[1] > n:
            shift = (rest[hand.faces] * (guess.barycentrics[0] - 1 / 3)[..., None]).sum(1).norm(dim=-1)
            shapes = _shapes(guess.opacities[0, n:], guess.scales[0, n:])
            add("on faces", {**shapes, "from the middle of the face, mm": 1e3 * shift})
    if network.config.fom == "on":
        mixed = network.feature_on_mesh.logits.softmax(-1).amax(-1)
        add("on faces", {"largest share of a corner in a face's features": mixed})
    lines = [
        [name, *(f"{value:.2f}" for value in torch.cat(values).quantile(torch.tensor(QUANTILES)).tolist())]
        for name, values in found.items()
    ]
    return markdown(["", *("median" if q == 0.5 else f"{q:.0%}" for q in QUANTILES)], lines)


def _shapes(opacities: torch.Tensor, scales: torch.Tensor) -> dict[str, torch.Tensor]:
    """Of Gaussians: [N] and [N, 3] [m]."""
    return {"opacity": opacities, "largest deviation, mm": 1e3 * scales.amax(-1), "smallest, mm": 1e3 * scales.amin(-1)}


def run(options: Options) -> list[Row]:
    """Make the sections."""
    with resources.as_file(asset(*BUNDLED)) as weights:
        network = load_network(weights, bundled_hand()).eval()
        texts = {
            "file": file_table(weights), "training": training_text(weights),
            "gaussians": gaussian_table(network, estimated_photos(options.people)),
        }  # fmt: skip
    return write_rows(options.out / "prior_card", [{"section": name, "text": text} for name, text in texts.items()])


SECTIONS = tuple(
    section_of("prior.md", name, lambda row: row["text"], section=name) for name in ("file", "training", "gaussians")
)
