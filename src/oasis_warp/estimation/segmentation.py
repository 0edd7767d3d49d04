"""Hand masks without the arm: the dense network's, drawn along the photo's edges, or the file's own alpha channel.

The network's mask has the pixels of its crop. GrabCut (Rother et al. 2004) decides on the pixels in a band around its
outline, and a guided filter (He et al. 2013) on their shares. The filter alone, without GrabCut, was tried: masks then
miss more of hand-drawn ones (IoU .961 for .972).
"""

import cv2
import numpy as np

from oasis_warp.core.errors import InputError
from oasis_warp.estimation.landmarks import FINGERS, box_size
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.pixel_reading import PixelReading
from oasis_warp.network.dense_network import ARM, BACKGROUND

_WRIST_CUT = 0.02
"""How far a mask extends past the wrist point towards the arm [m]."""
_WORK_SIZE = 512
"""Longest side of the image that is segmented [px]."""
_BAND = 3.0
"""Half the width of the band in which the colours decide [px of the network's crop]."""
_SURE_HAND, _SURE_BACKGROUND = 0.8, 0.1
"""Probabilities of the hand above and below which a pixel outside the band is decided."""
_BONE, _FINGER, _POSSIBLE = 0.045, 0.11, 0.03
"""Where the dense network is in doubt, the landmarks have seen a finger. Widths of the line along its bones that is
hand, and of the one in which colours decide, over the box of the landmarks; least probability of the hand there."""
_SURE = 0.9
"""Probability from which the network's word counts against an alpha channel."""
OPENCV, PACKAGE = 5, "opencv-contrib-python-headless"
"""Oldest major version, and the distribution: OpenCV 4 reads the landmark network wrongly, without an error."""
_LEAST = 20
"""Smallest number of pixels for a colour model."""
_EVERY = 4
"""Colour models are learned from every so manieth row and column: a sixteenth of the pixels tells as much."""


def mask_from_reading(rgb: np.ndarray, reading: PixelReading, xy: np.ndarray) -> np.ndarray:
    """Share of each pixel that is hand, [H, W] float32, as the network sees it.

    Args:
        rgb: The photo, [H, W, 3] bytes.
        reading: Reading of this photo.
        xy: Landmarks [px].
    """
    size, margin = (rgb.shape[1], rgb.shape[0]), 0.15 * box_size(xy)
    hand, arm = (reading.in_photo(share, size) for share in (reading.hand, reading.shares[ARM]))
    left, top = np.clip(np.floor(xy.min(0) - margin), 0, np.array(size) - 8).astype(int)
    right, bottom = np.clip(np.ceil(xy.max(0) + margin), [left + 8, top + 8], size).astype(int)
    part = slice(top, bottom), slice(left, right)
    factor = min(1.0, _WORK_SIZE / max(right - left, bottom - top))

    def smaller(plane: np.ndarray) -> np.ndarray:
        cut = np.ascontiguousarray(plane[part])
        return cut if factor == 1 else cv2.resize(cut, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)

    possible = smaller(hand) > np.maximum(_POSSIBLE, smaller(reading.in_photo(reading.front, size)))
    bones, fingers = (_lines((xy - [left, top]) * factor, width, possible.shape) for width in (_BONE, _FINGER))
    soft = _along_edges(
        smaller(rgb), smaller(hand), smaller(arm), bones & possible, fingers, _BAND * factor / reading.scale
    )  # fmt: skip
    mask = np.zeros(size[::-1], np.float32)
    mask[part] = cv2.resize(soft, (right - left, bottom - top), interpolation=cv2.INTER_LINEAR)
    return mask


def mask_from_alpha(alpha: np.ndarray, reading: PixelReading, xy: np.ndarray, scale: float) -> np.ndarray | None:
    """The file's own alpha channel [H, W] without the arm, or None if it does not show this hand alone.

    A cut-out of a hand is opaque on the hand and transparent around it; that of a whole person is opaque around it too.
    `scale` is in pixels per metre.
    """
    size, line = (alpha.shape[1], alpha.shape[0]), wrist_line(xy)
    inside = reading.in_photo(reading.hand, size) > _SURE
    around = (reading.in_photo(reading.shares[BACKGROUND], size) > _SURE) & line.above_mask(size)
    if not inside.any() or alpha[inside].mean() < 0.8 or (around.any() and alpha[around].mean() > 0.35):
        return None
    arm = ~line.above_mask(size, -_WRIST_CUT * scale / line.length)
    mask = np.where(arm, 0, alpha).astype(np.float32)
    return np.where(_touching(mask > 0.5, inside) | (mask <= 0.5), mask, 0)


def _lines(xy: np.ndarray, width: float, shape: tuple[int, int]) -> np.ndarray:
    """Lines along the fingers' bones, `width` times as wide as the box of the landmarks, [h, w]."""
    drawn = np.zeros(shape, np.uint8)
    for rows in FINGERS.values():
        points = np.round(16 * (xy[rows] - 0.5)).astype(np.int32)  # in sixteenths of a pixel
        cv2.polylines(drawn, [points], False, 1, max(1, round(width * box_size(xy))), cv2.LINE_8, 4)
    return drawn > 0


def _along_edges(
    rgb: np.ndarray, hand: np.ndarray, arm: np.ndarray, bones: np.ndarray, fingers: np.ndarray, band: float
) -> np.ndarray:
    """The soft mask of probabilities `hand`, drawn along the edges of the image; `band` in its pixels."""
    inside, outside = (
        cv2.distanceTransform((side > 0.5).astype(np.uint8), cv2.DIST_L2, 3)
        for side in (hand, 1 - hand)
    )
    labels = np.where(hand > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[(inside > band) & (hand > _SURE_HAND)] = cv2.GC_FGD
    labels[(outside > band) & (hand < _SURE_BACKGROUND)] = cv2.GC_BGD
    labels[arm > 0.5] = cv2.GC_PR_FGD  # skin, too
    beside = cv2.dilate((bones & (hand < 0.5)).astype(np.uint8), np.ones((2 * round(2 * band) + 1,) * 2)) > 0
    labels[fingers & beside & (labels == cv2.GC_BGD)] = cv2.GC_PR_FGD
    labels[bones] = cv2.GC_FGD
    for every in (_EVERY, 1):
        some = (slice(every // 2, None, every),) * 2
        if min((labels[some] == sure).sum() for sure in (cv2.GC_FGD, cv2.GC_BGD)) >= _LEAST:
            break
    else:
        return hand
    cv2.setRNGSeed(0)  # GrabCut starts from random clusters
    models, bgr = (np.zeros((1, 65)), np.zeros((1, 65))), rgb[..., ::-1].copy()
    cv2.grabCut(bgr[some].copy(), labels[some].copy(), None, *models, 1, cv2.GC_INIT_WITH_MASK)
    cv2.grabCut(bgr, labels, None, *models, 1, cv2.GC_EVAL_FREEZE_MODEL)
    mask = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)) & (arm < np.maximum(hand, 0.3))
    mask = _touching(mask, (hand > _SURE) | bones).astype(np.float32)
    soft = cv2.ximgproc.guidedFilter(rgb, mask, max(2, round(1.5 * band)), 1e-4 * 255**2)
    return np.clip((soft - 0.1) / 0.8, 0, 1)


def check_opencv() -> None:
    """Check that OpenCV is the one that the estimator needs, before any work.

    Raises:
        InputError: an older one, or one without the filters of its contributors, which another package put over it.
    """
    if int(cv2.__version__.split(".")[0]) >= OPENCV and hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        return
    raise InputError(
        f"opencv: expected version {OPENCV} or newer with ximgproc.guidedFilter, got {cv2.__version__} without, as "
        "another OpenCV package lies over ours; run `pip uninstall -y opencv-python opencv-python-headless "
        f"opencv-contrib-python`, then `pip install --force-reinstall --no-deps {PACKAGE}`."
    )


def _touching(mask: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The connected parts of `mask` that hold a sure pixel."""
    _, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return np.isin(label, np.setdiff1d(np.unique(label[sure & mask]), [0]))
