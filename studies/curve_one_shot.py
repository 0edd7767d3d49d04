"""Error against time of one-shot adaptation: steps, LoRA's rank, reference views, resolution; each turned alone.

    python studies/curve_one_shot.py out/curve --people 2 --device cpu
    python studies/curve_one_shot.py out/curve_gpu --people 16 --device cuda

Synthetic people that no training has met, as in `oasis evaluate`, with the estimator's errors. A run that was stopped
goes on; leaves curve.json and prints a table a light, of what has been measured for everybody.
"""

import argparse
import hashlib
import json
import statistics
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.nn.functional import avg_pool2d

from oasis_warp import __version__
from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.anchors import faces_of_vertices
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, HandCrop, TrainingBatch
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.evaluation.columns import COLORS, LIGHTS, markdown
from oasis_warp.evaluation.held_out import FIRST_PERSON, Lighting, Shoot, as_estimated, photograph, true_targets
from oasis_warp.evaluation.methods import Made, prior_digest
from oasis_warp.evaluation.metrics import Truth, match_colors, score
from oasis_warp.evaluation.synthetic import crop_of, draw_targets
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.prior import NetworkPrior, choose_prior
from oasis_warp.render.render import render

STEPS, RANKS, VIEWS, SIZES = (0, 10, 20, 40, 84, 200, 400, 1000), (1, 2, 4, 8, 16), (0, 1, 3, 7), (64, 128, 256)
"""Tried of each knob; sizes are the side of the crop that is adapted to [px], of which the prior reads the largest."""
FEW = 40
"""Steps of texture learning while another knob is turned."""
WAYS = ("field", "lora")


class Setting(NamedTuple):
    """One way to adapt."""

    config: AdaptConfig
    size: int = SIZES[-1]

    def name(self) -> str:
        """Of this setting in files; equal settings of two knobs are measured once."""
        return hashlib.sha256(json.dumps([asdict(self.config), self.size]).encode()).hexdigest()[:16]


DEFAULT = Setting(AdaptConfig())
PAPER = Setting(AdaptConfig(texture="lora", calibration_steps=100, texture_steps=400, references="all"))


def settings(longest: int) -> dict[str, Setting]:
    """By title, in the order of the table; without those of more steps than `longest`."""
    rows = {
        "default: the field until its loss is flat": DEFAULT,
        "`--light even`": Setting(AdaptConfig(light="even")),
    }
    for way in WAYS:
        rows |= {f"{way}, {n} steps": Setting(AdaptConfig(texture=way, texture_steps=n)) for n in STEPS}
    few = {way: AdaptConfig(texture=way, texture_steps=FEW) for way in WAYS}
    rows |= {
        f"lora, {FEW} steps, rank {n}": Setting(AdaptConfig(texture="lora", texture_steps=FEW, lora_rank=n))
        for n in RANKS
    }
    for way in WAYS:
        rows |= {
            f"{way}, {FEW} steps, reference views: {n}": Setting(
                AdaptConfig(texture=way, texture_steps=FEW, reference_views=n)
            )
            for n in VIEWS
        }
        every = AdaptConfig(texture=way, texture_steps=FEW, references="all")
        rows[f"{way}, {FEW} steps, all {every.reference_views} in each"] = Setting(every)
        rows |= {f"{way}, {FEW} steps, {n} px": Setting(few[way], n) for n in SIZES}
    rows["the paper's 100 + 400 steps, all views in each"] = PAPER
    return {title: setting for title, setting in rows.items() if (setting.config.texture_steps or 0) <= longest}


def shrink(crop: HandCrop, size: int) -> HandCrop:
    """The photo `size` pixels wide, a whole number of times smaller."""
    factor = len(crop.image) // size

    def pooled(picture: torch.Tensor) -> torch.Tensor:
        return avg_pool2d(picture[None], factor)[0]

    K = crop.camera.K.clone()
    K[:2] /= factor
    return crop._replace(
        image=pooled(crop.image.permute(2, 0, 1)).permute(1, 2, 0).contiguous(),
        mask=pooled(crop.mask[None])[0],
        above_wrist=pooled(crop.above_wrist[None])[0],
        camera=Camera(crop.camera.viewmat, K, size, size),
    )


def seconds(device: torch.device) -> float:
    """The process's own on the CPU, which others' work hardly changes; the clock's on a GPU."""
    if device.type == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


class Bench(NamedTuple):
    """One person in one light."""

    hand: HandModel
    crop: HandCrop
    batch: TrainingBatch
    turns: torch.Tensor | None
    truths: list[Truth]
    colors: str


def own_psnr(bench: Bench, made: Made) -> float:
    """Of the avatar over its photo, inside the outline [dB]."""
    crop, faces = bench.crop, bench.hand.faces
    rest = crop.rest.vertices
    light = None if made.light is None else (made.light, surface.vertex_normals(rest, faces))
    image, alpha = render(pose_gaussians(made.gaussians, faces, rest, crop.posed.vertices, light), crop.camera)
    return masked_psnr(image + (1 - alpha)[..., None] * crop.image, crop.image, inner_mask(crop.mask))


def other_psnr(bench: Bench, made: Made) -> float:
    """In other poses, from other sides, inside the outline: mean of the targets [dB]."""
    found = []
    for image, truth in zip(draw_targets(made, bench.hand, bench.batch, bench.turns), bench.truths, strict=True):
        judged = match_colors(image, truth.image, truth.mask) if bench.colors == "matched" else image
        found.append(score(judged, truth)["psnr_inner"])
    return statistics.fmean(value for value in found if value is not None)


def measure(prior: NetworkPrior, light: Lighting, number: int, options: argparse.Namespace, wanted: dict[str, Setting]):
    """Measure what is missing of one person in one light, and note each as it comes."""
    place, device = place_of(options.out, light, number), torch.device(options.device)
    found = json.loads(place.read_text()) if place.exists() else {}
    missing = {setting: title for title, setting in reversed(wanted.items()) if setting.name() not in found}
    if not missing:
        return
    hand, shoot = bundled_hand().to(device), Shoot(size=SIZES[-1])
    session = photograph(shoot, "ordinary", number, device)
    batch = as_estimated(hand, session, light, shoot, 1.0)
    exact = as_estimated(hand, session, light, shoot, 0.0)
    truths = true_targets(exact, hand, faces_of_vertices(hand.faces, len(hand.template)))
    bench = Bench(hand, crop_of(batch), batch, session.turns[light], truths, COLORS[light])
    guess, heads = prior.with_heads(bench.crop)
    for way in WAYS:  # kernels are loaded, and the photo's neighbours found, before anything is timed
        adapt(bundled_hand(), guess, bench.crop, AdaptConfig(texture=way, texture_steps=2), heads=heads)
    for setting, title in reversed(missing.items()):
        crop = shrink(bench.crop, setting.size)
        start = seconds(device)
        made = adapt(bundled_hand(), guess, crop, setting.config, heads=heads)
        taken, worn = seconds(device) - start, Made(made.gaussians, made.light)
        found[setting.name()] = {
            "seconds": taken,
            "steps": len(made.losses),
            "own": own_psnr(bench, worn),
            "other": other_psnr(bench, worn),
        }
        write_file(place, json.dumps(found).encode())
        print(f"{light}, person {number}: {title}", file=sys.stderr)


def place_of(folder: Path, light: str, number: int) -> Path:
    """Where the numbers of one person in one light are."""
    return folder / f"{light}_{number}.json"


def table(folder: Path, light: str) -> dict[str, Any] | None:
    """Means over everybody, of the settings that have been measured for all of them; None of nobody."""
    people = [json.loads(path.read_text()) for path in sorted(folder.glob(f"{light}_*.json"))]
    rows = []
    for title, setting in settings(STEPS[-1]).items():
        if not people or any(setting.name() not in found for found in people):
            continue
        own = [found[setting.name()] for found in people]
        rows.append(
            {
                "title": title,
                "steps": statistics.fmean(one["steps"] for one in own),
                "own": statistics.fmean(one["own"] for one in own),
                "other": statistics.fmean(one["other"] for one in own),
                "time": statistics.fmean(
                    one["seconds"] / found[DEFAULT.name()]["seconds"] for one, found in zip(own, people, strict=True)
                ),
            }
        )
    return {"light": light, "people": len(people), "rows": rows} if rows else None


def as_markdown(found: dict[str, Any]) -> str:
    """The table of one light, with its heading."""
    light = LIGHTS[found["light"]]
    lines = [
        [row["title"], f"{row['steps']:.0f}", f"{row['own']:.2f}", f"{row['other']:.2f}", f"{row['time']:.2f}"]
        for row in found["rows"]
    ]
    names = ["", "steps", "own photo", "other poses and views", "time"]
    return f"{light[0].upper()}{light[1:]}; people: {found['people']}:\n\n{markdown(names, lines)}"


def main() -> None:
    """Measure, write and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--prior", default="learned", help="learned, or a weights file")
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--lights", nargs="+", choices=list(LIGHTS), default=["same", "studio"])
    parser.add_argument("--longest", type=int, default=STEPS[-1], help="most steps tried")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    options = parser.parse_args()
    prior = choose_prior("learned" if options.prior == "learned" else Path(options.prior))
    if not isinstance(prior, NetworkPrior):
        raise SystemExit(f"--prior {options.prior}: has no heads to train; name a learned one.")
    about = {"version": __version__, "weights": prior_digest(prior), "device": options.device}
    open_resumable_folder(options.out, "settings.json", about, "a curve")
    wanted = settings(options.longest)
    for light in options.lights:
        for number in range(FIRST_PERSON, FIRST_PERSON + options.people):
            measure(prior, light, number, options, wanted)
    tables = [found for light in options.lights if (found := table(options.out, light))]
    write_file(options.out / "curve.json", json.dumps({"settings": about, "tables": tables}, indent=1).encode())
    for found in tables:
        print(f"{as_markdown(found)}\n")


if __name__ == "__main__":
    main()
