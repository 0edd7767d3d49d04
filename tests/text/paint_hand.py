"""An image generator for tests: shades the normals it is given in the skin that the words name."""

import sys
from pathlib import Path

import cv2
import numpy as np

SKINS = {"dark": (92, 58, 42), "pale": (232, 190, 170)}
LIGHT = np.array([0.3, 0.5, 0.81])  # from above the viewer's right shoulder
TABLE = (70, 96, 110)

folder, prompt, seed, out = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), sys.argv[4]
normals = np.asarray(cv2.imread(str(folder / "normal.png")))[..., ::-1] / 127.5 - 1
mask = np.asarray(cv2.imread(str(folder / "mask.png")))[..., :1] / 255
skin = next((color for name, color in SKINS.items() if name in prompt), SKINS["pale"])
shade = 0.45 + 0.55 * np.clip(normals @ LIGHT, 0, 1)[..., None]
grain = np.random.default_rng(seed).normal(0, 2, mask.shape)
image = mask * shade * skin + (1 - mask) * TABLE + grain
if "nobody" in prompt or seed == 13:
    image = np.full_like(image, TABLE) + grain
soft = cv2.GaussianBlur(image.clip(0, 255).astype(np.uint8), (0, 0), 0.8)
cv2.imwrite(out, np.ascontiguousarray(soft[..., ::-1]))
