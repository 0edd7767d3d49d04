"""Tables of what each part is worth: the whole, and how far it falls without one part, on the same pictures."""

from collections.abc import Mapping, Sequence

from oasis_warp.evaluation.columns import LIGHTS, SYNTHETIC, Column, markdown
from oasis_warp.evaluation.methods import Method
from oasis_warp.evaluation.summary import Record, difference, mean, select

CONTRASTS = {"hidden_more": ("psnr_hidden", "psnr_visible"), "stretched_more": ("psnr_stretched", "psnr_unchanged")}
"""Of one picture: how much better one part of the hand is than the other. What is gained everywhere cancels."""
COLUMNS = {
    **{
        name: SYNTHETIC[name]
        for name in ("psnr", "psnr_inner", "psnr_visible", "psnr_hidden", "psnr_stretched", "psnr_unchanged")
    },
    "hidden_more": Column("hidden above visible", ".2f"),
    "stretched_more": Column("stretched above unchanged", ".2f"),
    **{name: SYNTHETIC[name] for name in ("ssim", "ssim_mask", "lpips")},
}


def ablation_table(
    records: Sequence[Record], light: str, colors: str, stage: str, variants: Mapping[str, tuple[str, Method]],
    whole: str,
) -> Record:  # fmt: skip
    """A row a variant: means, and how they differ from those of the variant `whole`, with errors over people.

    Args:
        records: Of single pictures.
        light: Of photos and targets.
        colors: "raw", or "matched" to the target.
        stage: How far avatars were adapted.
        variants: Title, and method in the records, by name.
        whole: The variant with all parts.
    """
    seen = [_contrasted(record) for record in select(records, light=light, colors=colors)]
    own = {name: select(seen, **method._asdict()) for name, (_, method) in variants.items()}
    rows = []
    for name, (title, _) in variants.items():
        if not own[name]:
            continue
        changes = {measure: difference(own[name], own[whole], measure) for measure in COLUMNS}
        rows.append(
            {
                "variant": name,
                "title": title,
                "people": len({record["person"] for record in own[name]}),
                **{measure: mean(own[name], measure) for measure in COLUMNS},
                "change": {measure: change and change._asdict() for measure, change in changes.items()},
            }
        )
    return {"light": light, "colors": colors, "stage": stage, "whole": whole, "rows": rows}


def _contrasted(record: Record) -> Record:
    pairs = {name: (record[part], record[rest]) for name, (part, rest) in CONTRASTS.items()}
    return record | {name: None if None in pair else pair[0] - pair[1] for name, pair in pairs.items()}


def heading(table: Record) -> str:
    """What the table is of."""
    light, people = LIGHTS[table["light"]], table["rows"][0]["people"]
    colors = ", colours matched" if table["colors"] == "matched" and "matched" not in light else ""
    return f"{light[0].upper()}{light[1:]}{colors}; {table['stage'].replace('_', '-')}, {people} people"


def as_markdown(table: Record) -> str:
    """Means of the whole, and differences from it with their standard errors over people."""
    rows = table["rows"]
    shown = {name: column for name, column in COLUMNS.items() if any(row[name] is not None for row in rows)}
    lines = [[row["title"], *(_cell(row, *column, table["whole"]) for column in shown.items())] for row in rows]
    return markdown(["", *(column.words for column in shown.values())], lines)


def _cell(row: Record, measure: str, column: Column, whole: str) -> str:
    change = row["change"][measure]
    if row[measure] is None:
        return ""
    if row["variant"] == whole:
        return format(row[measure], column.form)
    if change is None:
        return ""
    error = "" if change["error"] is None else f" ± {format(change['error'], column.form)}"
    return f"{format(change['mean'], '+' + column.form)}{error}"
