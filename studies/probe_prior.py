"""Change one part of a trained network at a time, and evaluate each on the same people: what the part does by now.

    python studies/probe_prior.py out/probe --prior learned --people 16 --device cuda --workers 8

Nothing is trained: unlike studies/ablate_prior.py this says nothing of what the others would have learned without the
part, but it takes minutes, and shows which learnable numbers matter where they ended up. A run that was stopped goes
on; leaves ablation.json.
"""

import argparse
import copy
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch

from oasis_warp.data.output_files import write_file
from oasis_warp.evaluation.ablation import ablation_table, as_markdown, heading
from oasis_warp.evaluation.columns import COLORS
from oasis_warp.evaluation.methods import RAW, Method
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate
from oasis_warp.network.attention import VisibilityAttention
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior, choose_prior

FULL = "full"
LIGHT = "studio"
WEAK = 1e-3
"""Of the bias: next to none."""


def with_bias(share: float) -> Callable[[HandNetwork], None]:
    """A change of the strength of VPIA's bias (equation 6)."""

    def change(network: HandNetwork) -> None:
        if not isinstance(network.fusion, VisibilityAttention) or network.fusion.log_beta is None:
            raise SystemExit("expected a network whose attention has a bias; probe another.")
        network.fusion.log_beta.data += math.log(share)

    return change


def mix_evenly(network: HandNetwork) -> None:
    """Features of faces become the mean of their corners' (equation 7 without what it learns)."""
    network.feature_on_mesh.logits.data.zero_()


def _still(network: HandNetwork, output: str) -> None:
    start = 0
    for name, width in network.face_head.outputs.items():
        if name == output:
            network.face_head.last.weight.data[start : start + width] = 0
            network.face_head.last.bias.data[start : start + width] = 0
        start += width


class Probe(NamedTuple):
    """A row of the table."""

    title: str
    change: Callable[[HandNetwork], None]


PROBES = {
    FULL: Probe("as trained", lambda network: None),
    "no_bias": Probe("VPIA's bias off", with_bias(WEAK)),
    "twice": Probe("VPIA's bias twice as strong", with_bias(2.0)),
    "mixing": Probe("features of faces mixed evenly", mix_evenly),
    "places": Probe("Gaussians in the middle of faces", lambda network: _still(network, "barycentrics")),
    "colors": Probe("no colours of faces' own", lambda network: _still(network, "colors")),
}


def main() -> None:
    """Evaluate every probe, write and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--prior", default="learned", help="learned, or a weights file")
    parser.add_argument("--people", type=int, default=16)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--workers", type=int, default=0, help="processes that measure people side by side")
    options = parser.parse_args()
    prior = choose_prior(Path(options.prior) if options.prior != "learned" else "learned")
    if not isinstance(prior, NetworkPrior) or prior.network.config.fom == "off":
        parser.error("--prior: expected a network with Gaussians on faces")
    priors = {}
    for name, probe in PROBES.items():
        network = copy.deepcopy(prior.network)
        probe.change(network)
        priors[name] = NetworkPrior(network)
    options.out.mkdir(exist_ok=True)
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.people, lights=(LIGHT,), noise=(1.0,), curve=(),
        methods=tuple(Method(name, RAW) for name in PROBES),
    )  # fmt: skip
    found = evaluate(
        priors, config, options.out / f"people_{options.people}", torch.device(options.device),
        workers=options.workers, progress=lambda *how_far: print(*how_far, file=sys.stderr),
    )  # fmt: skip
    variants = {name: (probe.title, Method(name, RAW)) for name, probe in PROBES.items()}
    table = ablation_table(found["pictures"], LIGHT, COLORS[LIGHT], RAW, variants, FULL)
    settings = {"people": options.people, "prior": str(options.prior)}
    write_file(options.out / "ablation.json", json.dumps({"settings": settings, "tables": [table]}, indent=1).encode())
    print(f"{heading(table)}\n\n{as_markdown(table)}")


if __name__ == "__main__":
    main()
