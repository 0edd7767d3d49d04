"""Compare ways of skinning with flesh on bones, as Markdown tables and a picture.

    python asset_build/elastic_truth.py out/truth
    python asset_build/measure_correctives.py out/truth --picture docs/_static/hand_flesh.png

Whatever is fitted sees the part "train" of the truth only; all numbers are of the part "held_out", of another truth
with `--judge` (say, one with thicker bones). Times are processor time over that of blend skinning, both in numpy.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from elastic_hand import methods, truths
from elastic_hand.solid import MILLIMETRES, skinned
from elastic_hand.truths import HELD_OUT, TRAIN, Truth
from hand_build.anatomy import Array
from hand_build.quality import enclosed_volume, self_crossings
from measure_hand import SKEW, THUMB_SIDE, draw, label

from oasis_warp.hand.template import bundled_hand

BLENDED = 0.9
"""A vertex lies near a joint where no bone holds more of it."""
MUSH_ROUNDS = (10, 90)
RANK = 20
DRAWN = ("fist", "pinch", "thumbs_up")
"""Crossings are counted in these, too."""
DRAWN_METHODS = ("blend skinning", "correctives that ship", "30 shapes, contact left out", "delta mush, 90 rounds")
REPEATS = 5


@dataclass(frozen=True)
class Scores:
    """Of one way of skinning, over all poses."""

    near: float
    """Mean distance near joints [mm]."""
    far: float
    """99th percentile near joints [mm]."""
    largest: float
    volume: float
    """Mean of the volume inside the skin over that of the truth, minus 1."""
    crossings: int
    """Edges that cross other faces, in all poses drawn."""
    crossings_of_fist: int


Method = Callable[[Array], Array]
"""Joint angles [15, 3] to vertices [mm], [V, 3]."""


class Bench:
    """The hand, the truth and the ways of skinning."""

    def __init__(self, learnt: list[Truth], judged: list[Truth]) -> None:
        self.hand = bundled_hand().to(dtype=torch.float64)
        self.learnt = [t for t in learnt if t.part == TRAIN]
        self.judged = [t for t in judged if t.part == HELD_OUT]
        self.rest = self.hand.template.numpy() * MILLIMETRES
        self.weights = self.hand.weights.numpy()
        self.faces, self.rim = self.hand.faces.numpy(), self.hand.rim.numpy()
        self.near = self.weights.max(1) < BLENDED
        self.volumes = {t.name: self._volume(t.vertices[-1]) for t in self.judged}

    def _volume(self, vertices: Array) -> float:
        return enclosed_volume(vertices, self.faces, self.rim)

    def methods(self) -> dict[str, Method]:
        """By name; what can be fitted is fitted here."""
        rest, weights, hand = self.rest, self.weights, self.hand

        def bones(angles: Array) -> Array:
            return truths.bones(hand, angles)

        def plain(angles: Array) -> Array:
            return skinned(rest, weights, bones(angles))

        def shaped(shapes: methods.PoseShapes) -> Method:
            return lambda angles: skinned(rest + shapes.displacement(angles), weights, bones(angles))

        shipped = methods.PoseShapes(
            methods.flexion_features(hand), hand.corrective_basis.permute(2, 0, 1).numpy() * MILLIMETRES
        )
        mushes = {rounds: methods.DeltaMush(rest, self.faces, self.rim, rounds) for rounds in MUSH_ROUNDS}
        angles = np.concatenate([t.angles for t in self.learnt])
        groups = np.concatenate([np.full(len(t.angles), i) for i, t in enumerate(self.learnt)])
        wanted = np.stack([
            methods.unposed(v * MILLIMETRES, rest, weights, bones(a))
            for t in self.learnt
            for a, v in zip(t.angles, t.vertices, strict=True)
        ])  # fmt: skip
        flexion = methods.fit_shapes(methods.flexion_features(hand), angles, wanted, groups)
        wide = methods.fit_shapes(methods.wide_features(hand), angles, wanted, groups)
        present = shaped(shipped)
        found: dict[str, Method] = {
            "blend skinning": plain,
            "correctives that ship": present,
            "dual quaternions": lambda a: methods.dual_quaternions(rest, weights, bones(a)),
        }
        for rounds, mush in mushes.items():
            found[f"delta mush, {rounds} rounds"] = lambda a, mush=mush: mush(plain(a))
        mush = mushes[MUSH_ROUNDS[0]]
        found[f"correctives, then {MUSH_ROUNDS[0]} rounds"] = lambda a: mush(present(a))
        found["30 shapes, contact left out"] = shaped(flexion)
        found[f"{len(wide.basis)} shapes, contact left out"] = shaped(wide)
        found[f"those {len(wide.basis)}, rank {RANK}"] = shaped(methods.low_rank(wide, RANK))
        return found

    def scores(self, method: Method) -> Scores:
        """At the last step of each held-out pose."""
        distances, volumes, crossings = [], [], dict.fromkeys(DRAWN, 0)
        for truth in self.judged:
            got = method(truth.angles[-1])
            distances.append(np.linalg.norm(got - truth.vertices[-1] * MILLIMETRES, axis=1)[self.near])
            volumes.append(self._volume(got / MILLIMETRES) / self.volumes[truth.name] - 1)
            if truth.name in DRAWN:
                crossings[truth.name] = self_crossings(got, self.faces)
        every = np.stack(distances)
        far, volume = float(np.percentile(every, 99)), float(np.mean(volumes))
        return Scores(every.mean(), far, every.max(), volume, sum(crossings.values()), crossings["fist"])

    def picture(self, methods_drawn: dict[str, Method], size: int = 240) -> np.ndarray:
        """Rows of poses, columns of methods; the truth last."""
        rows = []
        for name in DRAWN:
            truth = next(t for t in self.judged if t.name == name)
            surfaces = {key: method(truth.angles[-1]) / MILLIMETRES for key, method in methods_drawn.items()}
            surfaces["flesh"] = truth.vertices[-1]
            for view in (THUMB_SIDE, SKEW):
                drawn = [draw(v, self.faces, view, size) for v in surfaces.values()]
                drawn = [d[size // 9 : -size // 20, size // 10 : -size // 5] for d in drawn]
                rows.append(
                    np.hstack([label(np.ascontiguousarray(d), key) for d, key in zip(drawn, surfaces, strict=True)])
                )
        return np.vstack(rows)


def seconds(method: Method, angles: Array) -> float:
    """Least time of a pose."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        method(angles)
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--judge", type=Path, help="a folder of another truth")
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    truth = truths.load(args.truth)
    bench = Bench(truth, truth if args.judge is None else truths.load(args.judge))
    found = bench.methods()
    at = bench.judged[0].angles[-1]
    print(f"{sum(len(t.angles) for t in bench.learnt)} states to learn from, {len(bench.judged)} poses held out")
    print("| skinning | mean [mm] | 99 % | max | volume | crossing edges | of the fist | time |")
    print("|---|---|---|---|---|---|---|---|")
    spent = {name: seconds(method, at) for name, method in found.items()}
    times = {name: f"{spent[name] / spent['blend skinning']:.1f}" for name in found}
    flesh = {t.angles[-1].tobytes(): t.vertices[-1] * MILLIMETRES for t in truth}
    for name, method in {**found, "flesh": lambda a: flesh[a.tobytes()]}.items():
        s = bench.scores(method)
        print(
            f"| {name} | {s.near:.2f} | {s.far:.1f} | {s.largest:.1f} | {s.volume:+.1%} "
            f"| {s.crossings} | {s.crossings_of_fist} | {times.get(name, '')} |",
            flush=True,
        )
    if args.picture is not None:
        cv2.imwrite(str(args.picture), bench.picture({name: found[name] for name in DRAWN_METHODS}))


if __name__ == "__main__":
    main()
