r"""Fill the numbers of the prior that ships into docs/prior.md, between its markers.

    oasis evaluate --dataset synthetic --out out/evaluation
    python studies/time_prior.py --json out/prior_cpu.json
    python studies/time_prior.py --device cuda --json out/prior_cuda.json
    python studies/evaluate_photos.py tests/data/photos --prior none --out out/photos/none
    python studies/evaluate_photos.py tests/data/photos --out out/photos/learned
    python studies/write_model_card.py docs/prior.md --metrics out/evaluation/metrics.json \
        --speed out/prior_cpu.json out/prior_cuda.json --gaussians 8 \
        --photos out/photos/none/photos.csv out/photos/learned/photos.csv

What the file is and how it was trained comes from its own header, the measurements from the evaluation, the times and
real photos from the other files, and what its Gaussians are like from so many synthetic photos; sections that nothing
is given for stay as they are. The prose around the markers is written by hand.
"""

import argparse
import csv
import hashlib
import json
import statistics
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from oasis_warp.assets import asset
from oasis_warp.avatar.anchors import INSET
from oasis_warp.avatar.observation import input_of_batch
from oasis_warp.core import surface
from oasis_warp.evaluation.columns import COLORS, GROUPS, LIGHTS, SYNTHETIC, cells, markdown
from oasis_warp.evaluation.held_out import FIRST_PERSON, Shoot, as_estimated, photograph
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import BUNDLED
from oasis_warp.network.weights_file import load_network, read_header

SECTIONS = ("file", "training", "measurements", "gaussians", "photos", "speed")
"""Each stands between `<!-- NAME -->` and `<!-- end of NAME -->`."""
METHODS = {
    ("mean", "calibrated"): "no prior: colour-matched mean hand",
    ("mean", "one_shot"): "no prior, one-shot",
    ("learned", "raw"): "the prior's guess",
    ("learned", "calibrated"): "its guess, colours matched",
    ("learned", "even_one_shot"): "the prior, one-shot without the photo's light",
    ("learned", "keep_one_shot"): "the prior, one-shot with the photo's light on the skin",
    ("learned", "one_shot"): "the prior, one-shot",
}
MEASURES = {
    name: SYNTHETIC[name]
    for name in ("psnr", "gain", "gain_error", "better", "psnr_visible", "psnr_hidden", "ssim_mask")
}  # fmt: skip
PHOTO_MEASURES = {
    "input_psnr_db": ("PSNR of the input view, dB", ".1f"),
    "coverage_worst": ("coverage, the worst of 32 views", ".3f"),
    "render_mask_iou": ("overlap with the mask", ".3f"),
}
"""Columns of the table of `studies/evaluate_photos.py`."""
SPREAD = (0.1, 0.5, 0.9)
"""Quantiles of what Gaussians are like."""
RETRAIN = ("steps", "hands", "views", "people", "size", "seed", "precision", "profile")
"""Options of `oasis pretrain` by their names in the notes."""

Row = dict[str, Any]


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
        options.append("--start START.safetensors")  # the weights of that SHA-256
    if notes.get("hold_out"):
        options.append("--hold-out " + " ".join(notes["hold_out"]))
    command = f"```sh\noasis pretrain prior {' '.join(options).replace('bfloat16', 'bf16')}\n```"
    return markdown(["setting", "value"], lines) + "\n\nThe same again:\n\n" + command


def measurement_tables(metrics: Path) -> str:
    """A table for each light and kind of people: what each way to an avatar comes to, with estimated poses."""
    summary: list[Row] = json.loads(metrics.read_text())["summary"]
    parts = []
    for light, words in LIGHTS.items():
        for group in dict.fromkeys(row["group"] for row in summary):
            wanted = {"group": group, "light": light, "noise": 1, "colors": COLORS[light]}
            rows = [row for row in summary if wanted.items() <= row.items()]
            if not rows:
                continue
            by_method, first = {(row["prior"], row["stage"]): row for row in rows}, rows[0]
            title = f"**{GROUPS[group]}, {words}**: {first['people']} people, {first['pictures']} pictures"
            lines = [[name, *cells(by_method[key], MEASURES)] for key, name in METHODS.items() if key in by_method]
            parts.append(title + "\n\n" + markdown(["", *(column.words for column in MEASURES.values())], lines))
    return "\n\n".join(parts)


@torch.no_grad()
def gaussian_table(network: HandNetwork, photos: int) -> str:
    """What the Gaussians of the guess are like: quantiles over those of so many synthetic photos.

    The distance under the skin is along its normal. A face's Gaussian may leave the middle of its face, and the face's
    features need not be the mean of its corners' (the paper's Feature-on-Mesh, equation 7).
    """
    hand, shoot = bundled_hand(), Shoot(targets=1)
    kinds: dict[str, list[dict[str, torch.Tensor]]] = {"on vertices": [], "on faces": []}
    for number in range(FIRST_PERSON, FIRST_PERSON + photos):
        session = photograph(shoot, "ordinary", number, torch.device("cpu"))
        batch = as_estimated(hand, session, "wild", shoot, 1.0)
        found, rest = network(input_of_batch(batch)), batch.rest[0]
        n = found.offsets.shape[1]
        deep = INSET - (found.offsets[0] * surface.vertex_normals(rest, hand.faces)).sum(-1)
        kinds["on vertices"].append(
            {**_shapes(found.opacities[0, :n], found.scales[0, :n]), "under the skin, mm": 1e3 * deep}
        )
        if found.opacities.shape[1] > n:
            shift = (rest[hand.faces] * (found.barycentrics[0] - 1 / 3)[..., None]).sum(1).norm(dim=-1)
            kinds["on faces"].append(
                {**_shapes(found.opacities[0, n:], found.scales[0, n:]), "from the middle of the face, mm": 1e3 * shift}
            )
    if network.config.fom == "on":
        mixed = network.feature_on_mesh.logits.softmax(-1).amax(-1)
        kinds["on faces"].append({"largest share of a corner in a face's features": mixed})
    lines = []
    for kind, tables in kinds.items():
        for name in dict.fromkeys(name for made in tables for name in made):
            values = torch.cat([made[name] for made in tables if name in made])
            quantiles = values.quantile(torch.tensor(SPREAD)).tolist()
            lines.append([f"{kind}: {name}", *(f"{value:.2f}" for value in quantiles)])
    return markdown(["", *("median" if q == 0.5 else f"{q:.0%}" for q in SPREAD)], lines)


def _shapes(opacities: torch.Tensor, scales: torch.Tensor) -> dict[str, torch.Tensor]:
    """Of Gaussians: [N] and [N, 3] [m]."""
    return {"opacity": opacities, "largest deviation, mm": 1e3 * scales.amax(-1), "smallest, mm": 1e3 * scales.amin(-1)}


def photo_table(none: Path, learned: Path) -> str:
    """Medians over the photos of which both priors made an avatar."""
    by_prior = {}
    for name, path in {"no prior": none, "the prior": learned}.items():
        with path.open(newline="") as file:
            by_prior[name] = {row["photo"]: row for row in csv.DictReader(file) if row["result"] == "ok"}
    both = set.intersection(*(set(rows) for rows in by_prior.values()))
    lines = [
        [name, *(format(statistics.median(float(rows[photo][key]) for photo in both), form)
                 for key, (_, form) in PHOTO_MEASURES.items())]
        for name, rows in by_prior.items()
    ]  # fmt: skip
    return markdown(["", *(words for words, _ in PHOTO_MEASURES.values())], lines) + f"\n\n{len(both)} photos, medians."


def speed_table(files: list[Path]) -> str:
    """Loading and encoding, a line a device."""
    lines = []
    for path in files:
        found = json.loads(path.read_text())
        memory = found["device_gib"] if found["device_gib"] is not None else found["grown_gib"]
        lines.append(
            [found["device"], f"{found['load_cpu_seconds']:.2f} s", f"{1e3 * found['encode_seconds_fastest']:.1f} ms",
             f"{1e3 * found['encode_seconds_median']:.1f} ms", f"{1e3 * found['encode_cpu_seconds_fastest']:.1f} ms",
             f"{memory:.2f} GiB", found["torch"]]
        )  # fmt: skip
    return markdown(
        ["device", "loading, CPU time", "encoding, fastest", "median", "CPU time", "memory", "torch"], lines
    )


def shown(value: object) -> str:
    """A setting, for people."""
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def put(page: str, name: str, text: str) -> str:
    """`page` with `text` between the markers of section `name`."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    head, _, rest = page.partition(begin)
    _, found, tail = rest.partition(end)
    if not found:
        raise SystemExit(f"expected {begin} and {end} in the page; put them where the numbers belong.")
    return f"{head}{begin}\n{text}\n{end}{tail}"


def main() -> None:
    """Read the numbers, rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--metrics", type=Path, help="metrics.json of `oasis evaluate`")
    parser.add_argument("--speed", type=Path, nargs="+", help="of studies/time_prior.py")
    parser.add_argument("--gaussians", type=int, default=0, help="synthetic photos to look at the prior's Gaussians on")
    parser.add_argument(
        "--photos", type=Path, nargs=2, metavar=("NONE", "LEARNED"), help="photos.csv of studies/evaluate_photos.py"
    )
    options = parser.parse_args()
    with resources.as_file(asset(*BUNDLED)) as weights:
        texts = {"file": file_table(weights), "training": training_text(weights)}
        if options.gaussians:
            texts["gaussians"] = gaussian_table(load_network(weights, bundled_hand()).eval(), options.gaussians)
    if options.photos is not None:
        texts["photos"] = photo_table(*options.photos)
    if options.metrics is not None:
        texts["measurements"] = measurement_tables(options.metrics)
    if options.speed is not None:
        texts["speed"] = speed_table(options.speed)
    page = options.page.read_text()
    for name, text in texts.items():
        page = put(page, name, text)
    options.page.write_text(page)


if __name__ == "__main__":
    main()
