"""The two bundled MediaPipe networks (palm detector, hand landmarks) behind OpenCV's dnn module, and their self-check.

Three faults of OpenCV raise no error: OpenCV 4 reads the landmark network wrongly, the new engine of OpenCV 5 returns
only one of the four outputs, and reading from memory ignores the choice of the engine. So the networks are checked
on an input with known outputs once per process.
"""

import functools
import hashlib
from dataclasses import dataclass
from importlib import resources

import cv2
import numpy as np

from oasis_warp.assets import asset
from oasis_warp.core.errors import InputError

PALM_SIZE, HAND_SIZE = 192, 224
"""Sides of the square inputs [px]."""

_FILES = {
    "palm_detection_full.tflite": "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    "hand_landmark_full.tflite": "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
}
_PALM_OUTPUTS = ("Identity", "Identity_1")
_HAND_OUTPUTS = ("Identity", "Identity_1", "Identity_2", "Identity_3")

# Outputs of LiteRT and OpenCV 5.0.0.93 for `drawn_hand`, which agree to 0.01 px. OpenCV 4.11 is off by 3 px and 0.27 m.
_KNOWN_ROWS = [0, 4, 8, 12, 16, 20]
_KNOWN_POINTS = [[117.17, 183.28], [37.23, 107.67], [90.23, 55.05], [108.72, 30.57], [133.29, 39.41], [165.54, 62.35]]
_KNOWN_WORLD = [
    [-0.0050, 0.0944, 0.0458], [-0.0760, -0.0108, -0.0116], [-0.0204, -0.0657, 0.0364],
    [-0.0067, -0.0860, 0.0381], [0.0187, -0.0732, 0.0328], [0.0435, -0.0478, 0.0071],
]  # fmt: skip
_KNOWN_SCORES = [0.802, 0.941]
_KNOWN_ANCHOR, _KNOWN_LOGIT, _KNOWN_BOX = 1694, 3.13, [[-7.17, 6.79], [64.47, 64.42]]
_TOLERANCE = {"pixels": 0.25, "metres": 0.001, "score": 0.02}
"""Allows for another summation order and half precision; the known faults are ten times as large."""


@dataclass(frozen=True)
class PalmOutput:
    """Raw output of the palm detector."""

    boxes: np.ndarray
    """[2016, 9, 2]: offset of the centre, size, offsets of seven points; in pixels of the 192-pixel input."""
    logits: np.ndarray
    """[2016]."""


@dataclass(frozen=True)
class HandOutput:
    """Raw output of the landmark network."""

    points: np.ndarray
    """[21, 2], in pixels of the 224-pixel input."""
    presence: float
    right: float
    """Probability of a right hand, on a photo that is not mirrored."""
    world: np.ndarray
    """[21, 3] metres, axes of the input: x right, y down, z away from the camera."""


@dataclass(frozen=True)
class Networks:
    """Both networks, loaded and checked; get them from `networks()`."""

    palm_net: "cv2.dnn.Net"
    hand_net: "cv2.dnn.Net"

    def palm(self, image: np.ndarray) -> PalmOutput:
        """Run the detector on a 192 x 192 RGB image of bytes."""
        boxes, logits = _forward(self.palm_net, image, _PALM_OUTPUTS)
        return PalmOutput(boxes.reshape(-1, 9, 2), logits)

    def hand(self, image: np.ndarray) -> HandOutput:
        """Run the landmark network on a 224 x 224 RGB image of bytes."""
        points, presence, right, world = _forward(self.hand_net, image, _HAND_OUTPUTS)
        return HandOutput(points.reshape(21, 3)[:, :2], float(presence[0]), float(right[0]), world.reshape(21, 3))


def _forward(net: "cv2.dnn.Net", image: np.ndarray, names: tuple[str, ...]) -> list[np.ndarray]:
    net.setInput(np.ascontiguousarray(image.transpose(2, 0, 1)[None], dtype=np.float32) / 255)
    return [np.array(output, dtype=np.float64).reshape(-1) for output in net.forward(list(names))]


@functools.cache
def networks() -> Networks:
    """Both networks, loaded and checked once per process.

    Raises:
        InputError: this installation does not run them correctly; see `check_networks`.
    """
    major = int(cv2.__version__.split(".")[0])
    if major < 5 or not hasattr(cv2.dnn, "ENGINE_CLASSIC"):
        raise InputError(
            f"OpenCV {cv2.__version__}: reads the hand landmark network wrongly; "
            "install opencv-contrib-python-headless 5.0.0.93 or newer."
        )
    loaded = []
    for name, digest in _FILES.items():
        with resources.as_file(asset("estimator", name)) as path:
            if not path.is_file():
                raise InputError(f"{path}: the network file is missing; install oasis_warp again.")
            if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                raise InputError(f"{path}: the network file is damaged (SHA-256 differs); install oasis_warp again.")
            try:
                # OpenCV 5 respects the engine only when reading from a path.
                loaded.append(cv2.dnn.readNetFromTFLite(str(path), cv2.dnn.ENGINE_CLASSIC))
            except cv2.error as error:
                raise _unusable(f"cannot load {name}") from error
    pair = Networks(*loaded)
    _check_outputs(pair)
    return pair


def check_networks() -> None:
    """Check that this installation runs the networks correctly: versions, files, and outputs for a known input.

    Raises:
        InputError: it does not; the sentence says what to install.
    """
    networks()


def drawn_hand(side: int) -> np.ndarray:
    """A simple drawing of an open right hand, [side, side, 3] bytes, for which the outputs are known."""
    y, x = np.mgrid[0:side, 0:side] * (224 / side)
    wrist, tips = (112.0, 196.0), ((40.0, 112.0), (82.0, 42.0), (110.0, 30.0), (137.0, 40.0), (164.0, 68.0))
    roots = ((92.0, 176.0), (92.0, 116.0), (111.0, 112.0), (128.0, 116.0), (144.0, 126.0))
    distance = np.full(x.shape, np.inf)
    strokes = [*zip(roots, tips, (10.0, 9.0, 9.0, 9.0, 8.0), strict=True)]
    strokes += [(wrist, root, 16.0) for root in roots] + [(wrist, (112.0, 260.0), 26.0)]
    for (ax, ay), (bx, by), radius in strokes:
        t = np.clip(((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2), 0, 1)
        distance = np.minimum(distance, np.hypot(x - ax - t * (bx - ax), y - ay - t * (by - ay)) - radius)
    inside = np.clip(0.5 - distance, 0, 1)[..., None]
    shade = np.clip(-distance / 14, 0, 1)[..., None]
    skin = np.array([150.0, 105.0, 85.0]) + shade * np.array([70.0, 65.0, 60.0])
    return np.round(inside * skin + (1 - inside) * np.array([60.0, 80.0, 110.0])).astype(np.uint8)


def _check_outputs(pair: Networks) -> None:
    """Run both networks on the drawing and compare with the known outputs."""
    try:
        palm, hand = pair.palm(drawn_hand(PALM_SIZE)), pair.hand(drawn_hand(HAND_SIZE))
    except (cv2.error, ValueError, IndexError) as error:
        raise _unusable("cannot run the hand networks or read their outputs") from error
    if palm.boxes.shape != (2016, 9, 2) or palm.logits.shape != (2016,):
        raise _unusable("returns outputs of the palm detector in another shape")
    comparisons = (
        (hand.points[_KNOWN_ROWS], _KNOWN_POINTS, "pixels"),
        (hand.world[_KNOWN_ROWS], _KNOWN_WORLD, "metres"),
        ([hand.presence, hand.right], _KNOWN_SCORES, "score"),
        (palm.boxes[_KNOWN_ANCHOR, :2], _KNOWN_BOX, "pixels"),
        (palm.logits[_KNOWN_ANCHOR] / 10, _KNOWN_LOGIT / 10, "score"),
    )
    for got, expected, unit in comparisons:
        if not np.allclose(got, expected, rtol=0, atol=_TOLERANCE[unit]):
            worst = float(np.abs(np.subtract(got, expected)).max())
            raise _unusable(f"computes the hand networks wrongly (off by {worst:.2g} {unit})")


def _unusable(what: str) -> InputError:
    return InputError(
        f"OpenCV {cv2.__version__}: {what}; install opencv-contrib-python-headless 5.0.0.93 or another 5.x version."
    )
