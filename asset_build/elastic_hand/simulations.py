"""Which poses the flesh is bent to, and the files that keep the results."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from hand_build.anatomy import Array

from elastic_hand.solid import MILLIMETRES
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import bone_transforms
from oasis_warp.synthetic.contact import sample_gesture, separate

TRAIN, HELD_OUT = "train", "held_out"
SINGLE_STEPS, SIDE_STEPS, POSE_STEPS = 4, 2, 5
N_TRAIN_GESTURES, N_HELD_OUT_GESTURES = 24, 4


@dataclass(frozen=True)
class Bend:
    """A pose that bones bend to in equal steps from rest."""

    name: str
    part: str
    """TRAIN or HELD_OUT."""
    angles: Array
    """[15, 3], radians."""
    steps: int


@dataclass(frozen=True)
class Simulation:
    """Flesh on the way to the pose of a `Bend`."""

    name: str
    part: str
    angles: Array
    """Of every step, [K, 15, 3]."""
    vertices: Array
    """Of the hand [m], [K, V, 3]."""
    kept: Array
    """Volume of the flesh, as a share of that at rest, [K]."""
    inverted: Array
    """Share of the flesh that is turned inside out, [K]."""


def bends(hand: HandModel) -> list[Bend]:
    """Every joint alone and sampled gestures to learn from; named poses and other gestures to be judged by."""
    limits = hand.pose_limits.double().numpy()
    names = hand.joint_names
    found = []

    def alone(joint: int, axis: int, end: int, steps: int, name: str) -> Bend:
        angles = np.zeros((15, 3))
        angles[joint - 1, axis] = limits[joint, axis, end]
        return Bend(name, TRAIN, angles, steps)

    found += [alone(joint, 0, 1, SINGLE_STEPS, names[joint]) for joint in range(1, 16)]
    for joint in (1, 4, 7, 10, 13):
        for end, sign in enumerate("-+"):
            found.append(alone(joint, 1, end, SIDE_STEPS, f"{names[joint]}_abduction{sign}"))
    found += [alone(13, 2, end, SIDE_STEPS, f"thumb1_twist{sign}") for end, sign in enumerate("-+")]
    exact = hand.to(dtype=torch.float64)
    for name in POSE_NAMES[1:]:
        found.append(Bend(name, HELD_OUT, named_pose(exact, name).numpy(), POSE_STEPS))
    for part, count, seed in ((TRAIN, N_TRAIN_GESTURES, 1), (HELD_OUT, N_HELD_OUT_GESTURES, 2)):
        for index, (gesture, angles) in enumerate(_apart(exact, _drawn(exact, count, seed))):
            found.append(Bend(f"{part}{index}_{gesture}", part, angles, POSE_STEPS))
    return found


def gestures(hand: HandModel, count: int, seed: int) -> list[Array]:
    """Angles [15, 3] of sampled gestures, and of the same with their parts pushed apart; `hand` is float64."""
    drawn = _drawn(hand, count, seed)
    return [angles[1:] for _, angles in drawn] + [angles for _, angles in _apart(hand, drawn)]


def _drawn(hand: HandModel, count: int, seed: int) -> list[tuple[str, Array]]:
    rng = np.random.default_rng(seed)
    return [sample_gesture(rng, hand) for _ in range(count)]


def _apart(hand: HandModel, drawn: list[tuple[str, Array]]) -> list[tuple[str, Array]]:
    joints = np.tile(hand.joints.numpy() * MILLIMETRES, (len(drawn), 1, 1))
    apart, _ = separate(np.stack([a for _, a in drawn]), joints)
    return [(name, angles[1:]) for (name, _), angles in zip(drawn, apart, strict=True)]


def bones(hand: HandModel, angles: Array) -> Array:
    """Rest to posed [mm] of every bone, [16, 3, 4]; `hand` is float64."""
    one, origin = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    rotation, translation = bone_transforms(hand, hand.joints, HandPose(torch.from_numpy(angles), one, origin))
    return torch.cat([rotation, translation[..., None] * MILLIMETRES], -1).numpy()


def save(folder: Path, simulation: Simulation) -> None:
    """Write `NAME.npz`."""
    np.savez(
        folder / f"{simulation.name}.npz", part=simulation.part, angles=simulation.angles, kept=simulation.kept,
        inverted=simulation.inverted, vertices=simulation.vertices.astype(np.float32),
    )  # fmt: skip


def load(folder: Path) -> list[Simulation]:
    """All simulations in a folder."""
    found = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in ("angles", "kept", "inverted")}
            vertices = stored["vertices"].astype(np.float64)
            found.append(Simulation(path.stem, str(stored["part"]), vertices=vertices, **arrays))
    return found
