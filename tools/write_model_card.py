r"""Fill the numbers of the prior that ships into docs/prior.md, between its markers.

    oasis evaluate --dataset synthetic --out out/evaluation
    python tools/time_prior.py --json out/prior_cpu.json
    python tools/time_prior.py --device cuda --json out/prior_cuda.json
    python tools/write_model_card.py docs/prior.md --metrics out/evaluation/metrics.json \
        --speed out/prior_cpu.json out/prior_cuda.json

What the file is and how it was trained comes from its own header, the measurements from the evaluation, the times from
the other files; sections whose files are not given stay as they are. The prose around the markers is written by hand.
"""

import argparse
import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

from oasis_warp.assets import asset
from oasis_warp.network.prior import BUNDLED
from oasis_warp.network.weights_file import read_header

SECTIONS = ("file", "training", "measurements", "speed")
"""Each stands between `<!-- NAME -->` and `<!-- end of NAME -->`."""
METHODS = {
    ("mean", "calibrated"): "no prior: colour-matched mean hand",
    ("mean", "one_shot"): "no prior, one-shot",
    ("learned", "raw"): "the prior's guess",
    ("learned", "calibrated"): "its guess, colours matched",
    ("learned", "one_shot"): "the prior, one-shot",
}
MEASURES = {
    "psnr": ("PSNR, dB", ".2f"),
    "psnr_visible": ("where the photo shows the surface", ".2f"),
    "psnr_hidden": ("where it does not", ".2f"),
    "ssim_mask": ("SSIM", ".3f"),
    "gain": ("gain, dB", "+.2f"),
    "better": ("people who gain", ".0%"),
}
LIGHTS = {"studio": "photo in even light", "wild": "photo in any light"}
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
    return table(["", ""], [[name, text] for name, text in rows.items()])


def training_text(path: Path) -> str:
    """How it was trained, and the command that does so again."""
    notes = json.loads(read_header(path)["notes"])
    flat = {name: value for name, value in notes.items() if not isinstance(value, dict)}
    lines = [[name.replace("_", " "), shown(value)] for name, value in flat.items()]
    losses = ", ".join(f"{name.replace('_', ' ')} {shown(value)}" for name, value in notes.get("losses", {}).items())
    if losses:
        lines.append(["losses", losses])
    options = [f"--{name} {notes[name]}" for name in RETRAIN if name in notes]
    if notes.get("hold_out"):
        options.append("--hold-out " + " ".join(notes["hold_out"]))
    command = f"```sh\noasis pretrain prior {' '.join(options).replace('bfloat16', 'bf16')}\n```"
    return table(["setting", "value"], lines) + "\n\nThe same again:\n\n" + command


def measurement_tables(metrics: Path) -> str:
    """A table for each light and kind of people: what each way to an avatar comes to, with estimated poses."""
    summary: list[Row] = json.loads(metrics.read_text())["summary"]
    parts = []
    for light, words in LIGHTS.items():
        for group in dict.fromkeys(row["group"] for row in summary):
            wanted = {"group": group, "light": light, "noise": 1, "colors": "matched"}
            rows = [row for row in summary if wanted.items() <= row.items()]
            if not rows:
                continue
            by_method, first = {(row["prior"], row["stage"]): row for row in rows}, rows[0]
            title = f"**{group}, {words}**: {first['people']} people, {first['pictures']} pictures"
            lines = [[name, *cells(by_method[key])] for key, name in METHODS.items() if key in by_method]
            parts.append(title + "\n\n" + table(["", *(name for name, _ in MEASURES.values())], lines))
    return "\n\n".join(parts)


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
    return table(
        ["device", "loading, CPU time", "encoding, fastest", "median", "CPU time", "memory", "torch"], lines
    )


def cells(row: Row) -> list[str]:
    """The measures of a row of the summary."""
    return ["" if row[key] is None else format(row[key], form) for key, (_, form) in MEASURES.items()]


def shown(value: object) -> str:
    """A setting, for people."""
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def table(heading: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(heading) + " |", "|" + "---|" * len(heading)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


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
    parser.add_argument("--speed", type=Path, nargs="+", help="of tools/time_prior.py")
    options = parser.parse_args()
    with resources.as_file(asset(*BUNDLED)) as weights:
        texts = {"file": file_table(weights), "training": training_text(weights)}
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
