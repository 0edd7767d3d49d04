"""Tables of what each part is worth: the whole, and how far it falls without one part, on the same pictures."""

from collections.abc import Mapping, Sequence

from oasis_warp.evaluation.columns import ABLATION, COLORS, SYNTHETIC, markdown
from oasis_warp.evaluation.methods import Method
from oasis_warp.evaluation.summary import Record, difference, mean, select


def ablation_rows(
    records: Sequence[Record], light: str, variants: Mapping[str, tuple[str, Method]], whole: str
) -> list[Record]:
    """A row a variant: means, and how they differ from those of the variant `whole`.

    Args:
        records: Of single pictures.
        light: Of the photos.
        variants: Title, and method in the records, by name.
        whole: The variant with all parts.
    """
    seen = select(records, light=light, colors=COLORS[light])
    own = {name: select(seen, **method._asdict()) for name, (_, method) in variants.items()}
    rows = []
    for name, (title, _) in variants.items():
        if not own[name]:
            continue
        changes = {measure: difference(own[name], own[whole], measure) for measure in ABLATION}
        rows.append(
            {
                "variant": name,
                "title": title,
                "people": len({record["person"] for record in own[name]}),
                **{measure: mean(own[name], measure) for measure in ABLATION},
                "change": {measure: change and change._asdict() for measure, change in changes.items()},
            }
        )
    return rows


def as_markdown(rows: Sequence[Record], whole: str) -> str:
    """Means of the variant `whole`, and differences from it with their standard errors over people."""
    shown = [measure for measure in ABLATION if any(row[measure] is not None for row in rows)]
    heading = ["", *(SYNTHETIC[measure].words for measure in shown)]
    return markdown(heading, [[row["title"], *(_cell(row, measure, whole) for measure in shown)] for row in rows])


def _cell(row: Record, measure: str, whole: str) -> str:
    digits = 2 if measure.startswith("psnr") else 4
    change = row["change"][measure]
    if row[measure] is None:
        return ""
    if row["variant"] == whole:
        return f"{row[measure]:.{digits}f}"
    if change is None:
        return ""
    error = "" if change["error"] is None else f" ± {change['error']:.{digits}f}"
    return f"{change['mean']:+.{digits}f}{error}"
