"""Readers of splat files, written from the formats' descriptions alone, in numpy."""

import numpy as np


def read_ply(path):
    """Columns of a binary PLY of floats, by name."""
    head, data = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    assert len(lines) == 3 + len(names)  # nothing else, no comment either
    rows = np.frombuffer(data, "<f4").reshape(int(lines[2].removeprefix("element vertex ")), len(names))
    return dict(zip(names, rows.T, strict=True))


def columns(table, prefix, count):
    return np.stack([table[f"{prefix}_{k}"] for k in range(count)], 1)


def gaussians_of_ply(path):
    """Means, quats (wxyz), scales, opacities and colours; y down."""
    table = read_ply(path)
    means = np.stack([table[axis] for axis in "xyz"], 1)
    opacities = 1 / (1 + np.exp(-table["opacity"]))
    colors = 0.5 + columns(table, "f_dc", 3) * 0.28209479177387814
    return means, columns(table, "rot", 4), np.exp(columns(table, "scale", 3)), opacities, colors
