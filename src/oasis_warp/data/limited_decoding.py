"""Decode a picture in a child process whose memory and time are bounded, for files whose headers cannot be trusted.

Run as a program it reads the file from stdin and writes pixels and EXIF to stdout; it needs OpenCV and NumPy alone.
"""

import io
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

MAX_BYTES, MAX_SECONDS = 4 << 30, 30
"""Address space and CPU time of the child: four times the largest picture that is decoded, and ample time."""
PATIENCE = 300
"""Seconds to wait for the child, on a machine that is busy with other things."""


def decode_limited(data: bytes, flags: int) -> tuple[np.ndarray, bytes] | None:
    """The pixels of a picture as `cv2.imdecode` has them, and its EXIF block; None where it cannot be decoded."""
    try:
        done = subprocess.run(
            [sys.executable, str(Path(__file__)), str(flags)], input=data, capture_output=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode != 0:
        return None
    stream = io.BytesIO(done.stdout)
    return np.load(stream, allow_pickle=False), stream.read()


def _decode() -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limits
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS))
    data = np.frombuffer(sys.stdin.buffer.read(), np.uint8)
    pixels, kinds, chunks = cv2.imdecodeWithMetadata(data, int(sys.argv[1]))
    if pixels is None:
        sys.exit(1)
    np.save(sys.stdout.buffer, np.ascontiguousarray(pixels), allow_pickle=False)
    for kind, chunk in zip(kinds, chunks, strict=True):
        if kind == cv2.IMAGE_METADATA_EXIF:
            sys.stdout.buffer.write(bytes(chunk))
            break


if __name__ == "__main__":
    _decode()
