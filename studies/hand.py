"""How the bundled hand bends: volume and crossing edges of poses, on the mean hand and on hands of random shape.

Fills docs/hand.md (bending), and draws docs/_static/hand_poses.png and hand_correctives.png.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from statistics import mean

import numpy as np
import torch
from asset_build.hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.cli.summary import Panel, draw_mesh, make_sheet, panel_side, shade_mesh
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.data.pictures import write_picture
from oasis_warp.hand.contact import resolve_contact
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.contact import sample_gesture, separate
from studies.harness import Row, StudyOptions, measured
from studies.tables import Column, Section, groups, table

FACING = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up, palm to the camera."""
AZIMUTHS = (0.0, math.pi, math.pi / 2, math.pi / 5)
"""Azimuths of the views: palm, back, the thumb's side and between [rad]."""
CORRECTED_POSES = ("fist", "thumbs_up", "pinch", "ok", "open")
WIDTH = 1500
"""Width of the pictures [px]."""
GESTURES = "gestures"


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    hands: int = 20
    """Hands of random shape, beside the mean hand: each coefficient has a standard deviation of 1."""
    gestures: int = 24
    """Sampled beside the named poses, their parts pushed apart on the mean hand's joints."""
    seed: int = 11


def posed(hand: HandModel, angles: torch.Tensor, shape: torch.Tensor) -> PosedHand:
    """A hand in a pose."""
    pose = HandPose(angles.to(hand.template), FACING.to(hand.template), torch.tensor([0.0, 0.0, 0.5]).to(hand.template))
    return skin(hand, rest_hand(hand, shape.to(hand.template)), pose)


def without_correctives(hand: HandModel) -> HandModel:
    """The same hand, posed by blend skinning alone."""
    return dataclasses.replace(hand, corrective_basis=hand.corrective_basis[..., :0])


def measure_pose(pose: str, gesture: torch.Tensor | None, shapes: torch.Tensor) -> Iterator[Row]:
    """A row for each hand in a named pose or a gesture, the mean one first.

    Crossing edges, volume [cm^3] and the largest shift [mm].
    """
    hand = bundled_hand()
    faces, rim = hand.faces.numpy(), hand.rim.numpy()
    for number, shape in enumerate(shapes):
        angles = named_pose(hand, pose, rest_hand(hand, shape)) if gesture is None else gesture
        surfaces = {"skinned": posed(hand, angles, shape).vertices}
        surfaces["contact"] = resolve_contact(hand, surfaces["skinned"]).vertices
        if number == 0:
            surfaces["plain"] = posed(without_correctives(hand), angles, shape).vertices
        row: Row = {"pose": pose, "hand": number}
        for name, surface in surfaces.items():
            vertices = surface.double().numpy()
            row[f"{name} volume"] = 1e6 * enclosed_volume(vertices, faces, rim)
            row[f"{name} crossings"] = self_crossings(vertices, faces)
        shift = (surfaces["contact"] - surfaces["skinned"]).norm(dim=1)
        yield {**row, "shift": 1e3 * float(shift.max())}


def run(options: Options) -> list[Row]:
    """Measure the named poses, then the gestures."""
    hand = bundled_hand()
    rng = np.random.default_rng(options.seed)
    drawn = np.stack([sample_gesture(rng, hand)[1] for _ in range(options.gestures)])
    apart, _ = separate(drawn, np.tile(1e3 * hand.joints.double().numpy(), (len(drawn), 1, 1)))
    shapes = torch.from_numpy(rng.normal(size=(options.hands, len(hand.shape_names)))).float()
    shapes = torch.cat([torch.zeros_like(shapes[:1]), shapes])
    cases: dict[str, tuple] = {name: (name, None, shapes) for name in POSE_NAMES}
    cases |= {f"{GESTURES} {k}": (GESTURES, torch.from_numpy(own[1:]), shapes) for k, own in enumerate(apart)}
    return measured("hand", cases, measure_pose, options)


def lines(rows: list[Row]) -> list[Row]:
    """A line for each pose, one for all gestures, and one for all together; crossing edges are sums over poses."""
    poses = {name: found for (name,), found in groups(rows, "pose").items()}
    poses["all"] = rows
    made = []
    for name, found in poses.items():
        own, others = ([row for row in found if (row["hand"] > 0) == other] for other in (False, True))
        n_others = len({row["hand"] for row in others})
        line: Row = {"pose": name, "shift": max(row["shift"] for row in found)}
        for key in ("plain", "skinned", "contact"):
            line[f"{key} volume"] = mean(row[f"{key} volume"] for row in own)
            line[f"{key} crossings"] = sum(row[f"{key} crossings"] for row in own)
        for key in ("skinned", "contact"):
            line[f"{key} others"] = sum(row[f"{key} crossings"] for row in others) / n_others
        made.append(line)
    return made


def views(surface: PosedHand, label: str, side: int) -> list[Panel]:
    """A posed hand from all sides."""
    panels = []
    for azimuth in AZIMUTHS:
        camera = orbit_camera(surface.vertices, azimuth, size=side)
        shade, inside = shade_mesh(surface, bundled_hand().faces, camera)
        white = np.full((side, side, 3), 255, np.uint8)
        panels.append(Panel(draw_mesh(white, shade.numpy(), inside.numpy() > 0, 1.0), label))
    return panels


def draw(rows: list[Row], static: Path) -> None:
    """Write `hand_poses.png`, and `hand_correctives.png`: blend skinning alone, and with correctives and contact."""
    hand = bundled_hand()
    side, mean_hand = panel_side(2 * len(AZIMUTHS), WIDTH), torch.zeros(len(hand.shape_names))
    strips, pairs = [], []
    for name in POSE_NAMES:
        angles = named_pose(hand, name)
        plain, full = (posed(model, angles, mean_hand) for model in (without_correctives(hand), hand))
        full = full._replace(vertices=resolve_contact(hand, full.vertices).vertices)
        strips.append(views(full, name, side))
        if name in CORRECTED_POSES:
            pairs.append(views(plain, f"{name}, before", side) + views(full, "after", side))
    blank = [Panel(np.full((side, side, 3), 255, np.uint8), "")] * len(AZIMUTHS)
    poses = [one + other for one, other in zip_longest(strips[::2], strips[1::2], fillvalue=blank)]
    for file, title, drawn in (("hand_poses", "Named poses", poses), ("hand_correctives", "Pose correctives", pairs)):
        write_picture(static / f"{file}.png", torch.from_numpy(make_sheet(title, "", drawn, WIDTH)))


COLUMNS = (
    Column("pose", "pose"), Column("volume, blend skinning [cm^3]", "plain volume", ".0f"),
    Column("with correctives", "skinned volume", ".0f"), Column("and contact", "contact volume", ".0f"),
    Column("crossing edges, blend skinning", "plain crossings"), Column("with correctives", "skinned crossings"),
    Column("and contact", "contact crossings"), Column("random shapes, with correctives", "skinned others", ".0f"),
    Column("and contact", "contact others", ".0f"), Column("largest shift [mm]", "shift", ".1f"),
)  # fmt: skip
SECTIONS = (Section("hand.md", "bending", table(COLUMNS, lines)),)
