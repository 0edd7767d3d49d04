"""Photo -> hands, each with 21 landmarks: palm detector, rotated crop, landmark network, a second tighter crop.

The method of MediaPipe Hands (Zhang et al. 2020), with fallback searches for hands that fill the frame, are dark, or
lie sideways.
"""

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from oasis_warp.estimation.networks import HAND_SIZE, PALM_SIZE, Networks

BONES = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (6, 7), (7, 8), (0, 9), (9, 10), (10, 11), (11, 12),
                  (0, 13), (13, 14), (14, 15), (15, 16), (0, 17), (17, 18), (18, 19), (19, 20)])  # fmt: skip
"""Rows of the two landmarks that each bone joins, from the wrist outwards, [20, 2]."""
FINGERS = {"thumb": [1, 2, 3, 4], "index": [5, 6, 7, 8], "middle": [9, 10, 11, 12], "ring": [13, 14, 15, 16],
           "little": [17, 18, 19, 20]}  # fmt: skip

_MIN_PRESENCE = 0.5
_MIN_GUESS = 0.8
"""Least presence and side score in fallback searches; the palm detector finds false hands there."""
_MARGIN = 0.35
"""Border replicated around the photo in fallback searches, as a fraction of its longer side."""

_BRIGHTENED = {1.0: "", 0.5: ", brightened", 0.3: ", much brightened"}
"""Exponents of gray levels in fallback searches, and how their source names them."""


@dataclass(frozen=True)
class DetectedHand:
    """One hand, in pixels of the image that was searched."""

    xy: np.ndarray
    """[21, 2] px."""
    world: np.ndarray
    """[21, 3] metres in the camera's axes, origin near the middle of the hand."""
    presence: float
    right: float
    """Probability of a right hand."""
    palm_score: float
    source: str

    @property
    def side_score(self) -> float:
        """Confidence in the likelier side."""
        return max(self.right, 1 - self.right)


@dataclass(frozen=True)
class Crop:
    """A square of the image, rotated so that the fingers point up in it."""

    centre: np.ndarray
    side: float
    angle: float
    """Clockwise rotation of the crop in the image [rad]."""


def detect_hands(rgb: np.ndarray, nets: Networks, *, most: int = 8) -> list[DetectedHand]:
    """Hands in an RGB image of bytes, best palm first; fallback searches run only if there is none."""
    hands = _search(rgb, nets, 0.5, most, "network")
    if hands:
        return hands
    margin = int(_MARGIN * max(rgb.shape[:2]))
    wide = cv2.copyMakeBorder(rgb, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    for quarter_turns, min_score, (exponent, light) in itertools.product(range(4), (0.5, 0.25), _BRIGHTENED.items()):
        image = cv2.LUT(np.ascontiguousarray(np.rot90(wide, quarter_turns)), _brightening_table(exponent))
        rotated = f", turned by {90 * quarter_turns} degrees" if quarter_turns else ""
        weak = ", weak" if min_score < 0.5 else ""
        found = _search(image, nets, min_score, most, f"network (margin{light}{rotated}{weak})")
        sure = [hand for hand in found if min(hand.presence, hand.side_score) >= _MIN_GUESS]
        if sure:
            return [_undo_rotation(hand, quarter_turns, wide.shape[:2], margin) for hand in sure]
    return []


def _brightening_table(exponent: float) -> np.ndarray:
    """A table of gray levels that brightens where `exponent` is below 1."""
    return np.round(255 * (np.arange(256) / 255) ** exponent).astype(np.uint8)


def _undo_rotation(hand: DetectedHand, quarter_turns: int, size: tuple[int, int], margin: int) -> DetectedHand:
    """A hand found after counter-clockwise right angles, in the image of `size` before them, without its margin."""
    xy, world = hand.xy, hand.world
    for quarter_turn in range(quarter_turns, 0, -1):
        height = size[quarter_turn % 2]  # of the image after this turn
        xy = np.stack([height - xy[:, 1], xy[:, 0]], 1)
        world = np.stack([-world[:, 1], world[:, 0], world[:, 2]], 1)
    return replace(hand, xy=xy - margin, world=world)


def _search(rgb: np.ndarray, nets: Networks, min_score: float, most: int, source: str) -> list[DetectedHand]:
    hands: list[DetectedHand] = []
    for score, box, points in palms(rgb, nets, min_score)[:most]:
        first = read_crop(rgb, nets, crop_of_palm(box, points), score, source)
        second = read_crop(rgb, nets, crop_of_landmarks(first.xy), score, source)
        hand = second if second.presence >= min(_MIN_PRESENCE, first.presence) else first
        # Two palms may lead to the same hand.
        if hand.presence >= _MIN_PRESENCE and not any(_is_same_hand(hand.xy, other.xy) for other in hands):
            hands.append(hand)
    return hands


def _is_same_hand(a: np.ndarray, b: np.ndarray) -> bool:
    return float(np.linalg.norm(a - b, axis=1).mean()) < 0.15 * box_size(a)


def box_size(xy: np.ndarray) -> float:
    """Longer side of the box of the landmarks [px], the unit of all distances relative to the hand."""
    return float(np.ptp(xy, axis=0).max())


def palms(rgb: np.ndarray, nets: Networks, min_score: float) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Score, box (centre x, y, width, height) and seven points of each palm, in pixels of `rgb`, best first."""
    height, width = rgb.shape[:2]
    scale = PALM_SIZE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR)
    border = np.array([(PALM_SIZE - size[0]) // 2, (PALM_SIZE - size[1]) // 2])
    letterbox = np.zeros((PALM_SIZE, PALM_SIZE, 3), np.uint8)
    letterbox[border[1] : border[1] + size[1], border[0] : border[0] + size[0]] = small
    raw = nets.palm(letterbox)
    scores = 1 / (1 + np.exp(-np.clip(raw.logits, -100, 100)))
    chosen = np.flatnonzero(scores >= min_score)
    anchors = _anchors()[chosen] * PALM_SIZE
    centres = (raw.boxes[chosen, 0] + anchors - border) / scale
    boxes = np.concatenate([centres, raw.boxes[chosen, 1] / scale], 1)
    points = (raw.boxes[chosen, 2:] + anchors[:, None] - border) / scale
    return _merge(boxes, scores[chosen], points)


def _anchors() -> np.ndarray:
    """Centres in [0, 1] of the 2016 anchors: two per cell of a 24 x 24 grid, then six per cell of a 12 x 12 grid."""
    grids = []
    for n, per_cell in ((24, 2), (12, 6)):
        centre = (np.arange(n) + 0.5) / n
        y, x = np.meshgrid(centre, centre, indexing="ij")
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], 1), per_cell, axis=0))
    return np.concatenate(grids)


def _merge(boxes: np.ndarray, scores: np.ndarray, points: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Score-weighted means of overlapping boxes (IoU > 0.3) and of their points."""
    low, high = boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2
    area = np.maximum(boxes[:, 2:], 0).prod(1)
    order, merged = np.argsort(-scores, kind="stable"), []
    while len(order):
        best = order[0]
        extent = np.minimum(high[best], high[order]) - np.maximum(low[best], low[order])
        overlap = np.maximum(extent, 0).prod(1)
        same = overlap > 0.3 * (area[best] + area[order] - overlap)
        same[0] = True
        group = order[same]
        weight = scores[group] / scores[group].sum()
        merged.append((float(scores[best]), weight @ boxes[group], np.tensordot(weight, points[group], 1)))
        order = order[~same]
    return merged


def crop_of_palm(box: np.ndarray, points: np.ndarray) -> Crop:
    """The square for the first pass: upright from wrist to middle knuckle, shifted towards the fingers, enlarged."""
    angle = _upright(points[2] - points[0])
    shift = 0.5 * box[3] * np.array([np.sin(angle), -np.cos(angle)])
    return Crop(box[:2] + shift, 2.6 * float(box[2:].max()), angle)


def crop_of_landmarks(xy: np.ndarray) -> Crop:
    """The tighter square around known landmarks."""
    angle = _upright(0.25 * (xy[5] + xy[13]) + 0.5 * xy[9] - xy[0])
    trunk = xy[[0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]]  # without the ends of the fingers
    quarter_turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    rotated = trunk @ quarter_turn.T
    low, high = rotated.min(0), rotated.max(0)
    centre = quarter_turn.T @ ((low + high) / 2 - np.array([0, 0.1 * (high[1] - low[1])]))
    return Crop(centre, 2.0 * float((high - low).max()), angle)


def _upright(direction: np.ndarray) -> float:
    """Angle of the crop in which `direction` points up, in [-pi, pi) [rad]."""
    angle = np.pi / 2 - np.arctan2(-direction[1], direction[0])
    return float(angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi)))


def read_crop(
    rgb: np.ndarray, nets: Networks, crop: Crop, palm_score: float = 1.0, source: str = "network", *,
    mirrored: bool = False,
) -> DetectedHand:  # fmt: skip
    """Landmarks in a crop, in pixels of `rgb`; `mirrored` shows the network the crop's mirror image."""
    cos, sin = np.cos(crop.angle), np.sin(crop.angle)
    quarter_turn = np.array([[cos, -sin], [sin, cos]])  # crop -> image
    pixel = crop.side / HAND_SIZE
    to_image = quarter_turn * pixel @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    middle = np.full(2, HAND_SIZE / 2)
    # OpenCV counts from the centre of the first pixel, we from its corner.
    affine = np.concatenate([to_image, (crop.centre - 0.5 - to_image @ (middle - 0.5))[:, None]], 1)
    source_image = rgb
    if pixel > 2:  # average before a strong reduction
        factor = 2.0 ** -np.floor(np.log2(pixel))
        source_image = cv2.resize(rgb, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        affine *= np.array([[source_image.shape[1] / rgb.shape[1]], [source_image.shape[0] / rgb.shape[0]]])
    image = cv2.warpAffine(source_image, affine, (HAND_SIZE, HAND_SIZE),
                           flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    seen = nets.hand(image)
    world = seen.world.copy()
    right = seen.right
    if mirrored:
        world[:, 0] *= -1
        right = 1 - right
    world[:, :2] = world[:, :2] @ quarter_turn.T
    xy = (seen.points - middle) @ to_image.T + crop.centre
    return DetectedHand(xy, world, seen.presence, right, palm_score, source)
