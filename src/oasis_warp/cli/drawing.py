"""Draw landmarks, a mesh and a sheet of captioned panels, with OpenCV on RGB bytes."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

Pixels = np.ndarray
"""RGB, uint8, shape [H, W, 3]."""

PAPER, INK, FAINT = (246, 246, 244), (34, 36, 40), (120, 122, 128)
OUTLINE = (255, 255, 255)
FINGER_COLORS = ((236, 112, 99), (244, 176, 66), (98, 186, 112), (82, 152, 222), (166, 118, 214))
"""Thumb to little finger."""
MARGIN, GAP, CAPTION, TITLE = 24, 12, 26, 44
"""Of a sheet [px]."""


class Panel(NamedTuple):
    """A square picture with a few words under it."""

    pixels: Pixels
    caption: str


def write_text(sheet: Pixels, text: str, x: int, y: int, size: int, color: tuple[int, int, int], weight: int) -> None:
    """Write `text` with its baseline at `y`, in the font that OpenCV carries."""
    cv2.putText(sheet, text, (x, y), color, cv2.FontFace("sans"), size, weight)


def draw_landmarks(pixels: Pixels, points: np.ndarray) -> Pixels:
    """The 21 points (wrist, then thumb to little finger), a line of one colour for each finger."""
    drawn = pixels.copy()
    width = max(1, round(pixels.shape[0] / 180))

    def place(point: np.ndarray) -> tuple[int, int]:
        return round(float(point[0]) * 16), round(float(point[1]) * 16)  # OpenCV's fixed point: 4 bits

    for finger, color in enumerate(FINGER_COLORS):
        chain = points[[0, *range(4 * finger + 1, 4 * finger + 5)]]
        for a, b in itertools.pairwise(chain):
            cv2.line(drawn, place(a - 0.5), place(b - 0.5), color, width, cv2.LINE_AA, 4)
        for point in chain[1:]:
            cv2.circle(drawn, place(point - 0.5), 24 * width, color, -1, cv2.LINE_AA, 4)
    cv2.circle(drawn, place(points[0] - 0.5), 24 * width, OUTLINE, -1, cv2.LINE_AA, 4)
    return drawn


def draw_mesh(pixels: Pixels, shade: np.ndarray, inside: np.ndarray, opacity: float = 0.55) -> Pixels:
    """A shaded surface (`shade` in [0, 1] where `inside`) laid over a picture, with its outline."""
    grey = (np.array((150, 178, 210)) * shade[..., None]).clip(0, 255)
    blend = np.where(inside[..., None], opacity * grey + (1 - opacity) * pixels, pixels).round().astype(np.uint8)
    edges, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(blend, edges, -1, OUTLINE, max(1, pixels.shape[0] // 260), cv2.LINE_AA)


def panel_side(n_panels: int, width: int) -> int:
    """Side of each of `n_panels` in one row of a sheet `width` pixels wide."""
    return (width - 2 * MARGIN - GAP * (n_panels - 1)) // n_panels


def make_sheet(title: str, subtitle: str, rows: Sequence[Sequence[Panel]], width: int) -> Pixels:
    """Rows of panels on plain paper; the panels of a row have the `panel_side` of their number."""
    sides = [panel_side(len(row), width) for row in rows]
    height = 2 * MARGIN + TITLE + sum(side + CAPTION + GAP for side in sides) - GAP
    sheet = np.full((height, width, 3), PAPER, np.uint8)
    place = (MARGIN, MARGIN + 22)
    write_text(sheet, title, *place, 24, INK, 600)
    left, _, length, _ = cv2.getTextSize((width, height), title, place, cv2.FontFace("sans"), 24, 600)
    write_text(sheet, subtitle, left + length + 20, place[1], 17, FAINT, 400)
    top = MARGIN + TITLE
    for row, side in zip(rows, sides, strict=True):
        for column, panel in enumerate(row):
            left = MARGIN + round(column * (width - 2 * MARGIN + GAP) / len(row))
            sheet[top : top + side, left : left + side] = panel.pixels
            write_text(sheet, panel.caption, left + 1, top + side + 19, 15, FAINT, 400)
        top += side + CAPTION + GAP
    return sheet
