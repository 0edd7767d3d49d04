"""How near each CUDA kernel comes to what the GPU can do: bytes and operations over time, against measured ceilings.

What a kernel must move and do is counted from the scene, by the formulas in `PICTURE_KERNELS` and `MESH_KERNELS`; its
time is the profiler's. Bytes are those that must reach or leave a multiprocessor, each input and output of a thread
once; scenes of tens of thousands of Gaussians fit into the L2 cache, so shares of the bandwidth of a copy through the
memory can be above what the memory itself sees. One operation is an addition, a multiplication or a function such as
2^x; a fused multiply-add is two, and one in float64, which an H200 does at half the rate, is four.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from oasis_kernels.constants import EPS2D
from oasis_kernels.rasterize.tiles_cuda import TILE, record_size
from oasis_warp.bench.gpu_cases import RASTERIZATION, UNVALIDATED, AvatarScene, avatar_scene, posing, size_name
from oasis_warp.bench.operators import OPERATORS, Results, forward, with_gradients
from oasis_warp.bench.rows import provenance
from oasis_warp.bench.scenes import HAND_GAUSSIANS, GaussianScene, MeshScene, hand_scenes
from oasis_warp.bench.timing import KernelTime, Probe, device_clock, kernel_times, time_groups
from oasis_warp.core.logging import Progress, silent
from oasis_warp.ops.projection import project

COPY_BYTES = 2**30
MATRIX = 8192
CEILING_GROUPS = 9


@dataclass(frozen=True)
class Counts:
    """The work of drawing a scene, summed over its cameras."""

    gaussians: int
    """Once for each camera."""
    drawn: int
    """Gaussians whose box contains a pixel."""
    box_pixels: int
    """In all boxes together."""
    pairs: int
    """Pairs of a Gaussian and a tile of 8 x 8 pixels that its box meets."""
    tiles: int
    busy_tiles: int
    """Tiles with a list that is not empty."""
    longest: int
    """Length of the longest list of a tile."""
    pixels: int
    views: int


@torch.no_grad()
def count(scene: GaussianScene) -> Counts:
    """The work of drawing `scene`."""
    across, down = -(-scene.width // TILE), -(-scene.height // TILE)
    n, n_views = len(scene.means), len(scene.viewmats)
    drawn = box_pixels = pairs = 0
    lists = []
    for view in scene.views():  # one by one: the projection of 64 views at once takes gigabytes
        boxes = project(
            view.means, view.quats, view.scales, view.opacities, view.viewmats, view.Ks, view.width, view.height,
            near_plane=0.01, far_plane=1e10, radius_clip=0.0, eps2d=EPS2D,
        ).tables().boxes.view(-1, 4)  # fmt: skip
        boxes = boxes[(boxes[:, 0] < boxes[:, 2]) & (boxes[:, 1] < boxes[:, 3])]
        x0, y0 = (boxes[:, :2] // TILE).unbind(-1)
        x1, y1 = ((boxes[:, 2:] + TILE - 1) // TILE).unbind(-1)
        drawn += len(boxes)
        box_pixels += int((boxes[:, 2:] - boxes[:, :2]).long().prod(-1).sum())
        pairs += int(((x1 - x0).long() * (y1 - y0)).sum())
        # Rectangles are added by their corners and summed along both axes.
        corners = torch.zeros((down + 1) * (across + 1), dtype=torch.int64, device=boxes.device)
        for x, y, sign in ((x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)):
            corner = (y * (across + 1) + x).long()
            corners.scatter_add_(0, corner, torch.full_like(corner, sign))
        lists.append(corners.view(down + 1, across + 1).cumsum(0).cumsum(1)[:down, :across])
    lengths = torch.stack(lists)
    return Counts(
        gaussians=n * n_views,
        drawn=drawn,
        box_pixels=box_pixels,
        pairs=pairs,
        tiles=n_views * across * down,
        busy_tiles=int((lengths > 0).sum()),
        longest=int(lengths.max()),
        pixels=n_views * scene.width * scene.height,
        views=n_views,
    )


@dataclass(frozen=True)
class MeshCounts:
    """The work of posing a mesh with Gaussians, or of finding the points that it hides."""

    vertices: int
    faces: int
    joints: int
    correctives: int
    """Displacements of every vertex."""
    vertex_gaussians: int
    face_gaussians: int
    points: int
    pixels: int


def count_mesh(scene: MeshScene) -> MeshCounts:
    """The work of posing or drawing the mesh of `scene`."""
    return MeshCounts(
        vertices=len(scene.rest_vertices),
        faces=len(scene.faces),
        joints=len(scene.transforms),
        correctives=0,
        vertex_gaussians=len(scene.vertex_index),
        face_gaussians=len(scene.face_index),
        points=len(scene.points),
        pixels=scene.width * scene.height,
    )


def count_avatar(scene: AvatarScene) -> MeshCounts:
    """The work of posing the Gaussians of an avatar."""
    return MeshCounts(
        vertices=len(scene.hand.template),
        faces=len(scene.hand.faces),
        joints=len(scene.hand.parents),
        correctives=scene.hand.corrective_basis.shape[-1],
        vertex_gaussians=len(scene.canonical.vertex_index),
        face_gaussians=len(scene.canonical.face_index),
        points=0,
        pixels=0,
    )


class Work(NamedTuple):
    """What a kernel must move and do in a call."""

    bytes: float
    flops: float


# Of a Gaussian: position 12, quaternion 16, scales 12, opacity 4; of its gradient as much less the opacity.
GAUSSIAN, GAUSSIAN_GRADIENT = 44, 40
# What a tile reads of a Gaussian: centre 16, whitening 16, opacity 4, colour 12.
LAYER = 48
# What a tile writes of a pair: six moments and the sums by three colours, padded.
RECORD = 4 * record_size(3, True, True)

PICTURE_KERNELS: Mapping[str, Callable[[Counts], Work]] = {
    # Writes means2d 8, covars2d 24, depth 4, conic 12, radii 8, float64 depth 8, centre 16, whitening 16, box 16.
    # Rotation 30, camera 18, Jacobian 10, two rows of J W R S 40, covariance and determinant 25, whitening, conic and
    # box 40, the centre and the determinant in float64 counted twice: 60; a dozen divisions and roots of 10 each.
    "project_gaussians": lambda c: Work((GAUSSIAN + 112) * c.gaussians, 340 * c.gaussians),
    # Box 16, number of the first pair 4; a counter is read and written.
    "count_pairs": lambda c: Work(20 * c.gaussians + 8 * c.pairs, 10 * c.gaussians + 2 * c.pairs),
    # Counter 4; tile, start and length 16, cursor 8.
    "place_tiles": lambda c: Work(28 * c.tiles, 12 * c.tiles),
    # Box 16, depth 8; a cursor of 4 is read and written, and a key of 8 written.
    "fill_tiles": lambda c: Work(24 * c.gaussians + 16 * c.pairs, 10 * c.gaussians + 4 * c.pairs),
    # Key 8, layer, sorted index 4; image 12, alpha, transmittance and stop 4 each; what a tile is 16.
    # A pixel of a box: offset 2, W d 6, |.|^2 3, exponent 2, cap and tests 3, weight and rest 2, colours 6. A pair: the
    # sort compares it log2(length)^2 / 2 times, some 30.
    "blend_tiles_3": lambda c: Work(
        (8 + LAYER + 4) * c.pairs + 24 * c.pixels + 16 * c.tiles, 24 * c.box_pixels + 30 * c.pairs
    ),
    # Index 4, layer, record; gradients by image and alpha 16, transmittance and stop 8.
    # A pixel of a box: the exponent again 16, transmittance back by a division 10, what is behind 10, the moments and
    # colours 24. A pair: nine sums over a warp, 31 additions each.
    "blend_tiles_backward_3": lambda c: Work(
        (4 + LAYER + RECORD) * c.pairs + 24 * c.pixels + 16 * c.tiles, 60 * c.box_pixels + 280 * c.pairs
    ),
    # Box 16, first pair 4, whitening 16, opacity 4; gradients by centre 8, covariance 24, opacity 4, colour 12.
    "gather_records_3": lambda c: Work(88 * c.gaussians + RECORD * c.pairs, 60 * c.gaussians + 9 * c.pairs),
    # Gradients by centre 8, covariance 24, depth 4, and radii 8 come in; the projection is worked out again, half of it
    # and its adjoint in float64.
    "project_gaussians_backward": lambda c: Work(
        (GAUSSIAN - 4 + 44 + GAUSSIAN_GRADIENT) * c.gaussians, 900 * c.gaussians
    ),
    # The last two in one: nothing goes through memory between them.
    "gather_project_backward": lambda c: Work(
        (40 + GAUSSIAN - 4 + GAUSSIAN_GRADIENT + 16) * c.gaussians + RECORD * c.pairs,
        960 * c.gaussians + 9 * c.pairs,
    ),
}
"""By the kernel's name, from the work of drawing."""

MESH_KERNELS: Mapping[str, Callable[[MeshCounts], Work]] = {
    # Position 12, weights and displacements in, position out. The displacements are added, 3 multiply-adds each, the
    # transforms blended, 12 a bone, and applied, 9.
    "skin": lambda c: Work(
        (24 + 4 * c.joints + 12 * c.correctives) * c.vertices + 48 * c.joints,
        (24 * c.joints + 6 * c.correctives + 18) * c.vertices,
    ),
    # Three indices and a row of 48 on the face at rest; posed corners, each vertex once; quaternion 16, area ratio 4,
    # row for the vertices 32. A frame of 40, roots and divisions of 10 each, the rotation in the plane, a product 28.
    "rotate_faces": lambda c: Work(12 * c.vertices + (60 + 52) * c.faces, 180 * c.faces),
    # Three corners a face: place 4 and row 32; quaternion 16 and area ratio 4 a vertex.
    "rotate_vertices": lambda c: Work(3 * 36 * c.faces + 24 * c.vertices, 3 * 18 * c.faces + 40 * c.vertices),
    # On a vertex: index 4, vertex 12, its quaternion 16 and ratio 4, offset 12, quaternion 16, scales 12; on a face:
    # index 4, corners 12, three vertices and quaternions 84, ratio 4, weights 12, quaternion 16, scales 12; 40 out.
    "pose_mesh_gaussians": lambda c: Work(
        (76 + 40) * c.vertex_gaussians + (144 + 40) * c.face_gaussians,
        110 * c.vertex_gaussians + 150 * c.face_gaussians,
    ),
    # A key a pixel.
    "clear_keys": lambda c: Work(8 * c.pixels, 0),
    # Three indices, each vertex once; in float64, counted twice: corners to the camera's axes 18 each, the planes of
    # depth and edges 60. What a pixel of a box takes depends on the view and is left out.
    "draw_faces": lambda c: Work(12 * c.faces + 12 * c.vertices, 2 * (54 + 60) * c.faces),
    # Key 8, depth 4 and face 4 a pixel; a point of 12, 9 keys about it, its score 4.
    "resolve_keys": lambda c: Work(16 * c.pixels + (16 + 72) * c.points, 100 * c.points),
}
"""By the kernel's name, from the work of posing or drawing a mesh."""


@dataclass(frozen=True)
class Ceilings:
    """What the GPU can do."""

    gb_s: float
    """Bytes read and written by a copy of 1 GiB [GB/s]."""
    gflop_s: float
    """Rate of a product of float32 matrices, without TF32 [GFLOP/s]."""


@dataclass(frozen=True, kw_only=True)
class KernelRow:
    """One kernel of one case."""

    case: str
    kernel: str
    launches: float
    """In a call."""
    us: float
    """Time of all launches of a call, together."""
    bytes: float | None
    """Bytes that the kernel must move. This and all that follows from it is None where the kernel has no formula."""
    flops: float | None
    gb_s: float | None
    gflop_s: float | None
    floor_us: float | None
    """What it would take at the nearer ceiling."""
    bound: str
    """The nearer ceiling: "bytes" or "flops"; "" without a formula."""
    ceiling_gb_s: float
    ceiling_gflop_s: float
    device: str
    commit: str
    versions: str

    @property
    def share(self) -> float | None:
        """Share of the nearer ceiling that the kernel reaches."""
        return None if self.floor_us is None else self.floor_us / self.us


def assess(
    case: str,
    times: Sequence[KernelTime],
    models: Mapping[str, Callable[[Any], Work]],
    counts: Any,
    ceilings: Ceilings,
    about: Mapping[str, str],
) -> list[KernelRow]:
    """Times of a case's kernels beside what they must move and do.

    Args:
        case: What it is called.
        times: Times of its kernels, the longest first.
        models: Formulas, by the kernel's name.
        counts: What they count from.
        ceilings: Ceilings of the GPU.
        about: device, commit and versions.
    """
    rows = []
    for time in times:
        work = models[time.name](counts) if time.name in models else None
        seconds = 1e-6 * time.us
        floors = {}
        if work is not None:
            floors = {"bytes": work.bytes / ceilings.gb_s / 1e3, "flops": work.flops / ceilings.gflop_s / 1e3}
        bound = max(floors, key=lambda name: floors[name], default="")
        rows.append(
            KernelRow(
                case=case,
                kernel=time.name,
                launches=time.launches,
                us=time.us,
                bytes=None if work is None else float(work.bytes),
                flops=None if work is None else float(work.flops),
                gb_s=None if work is None else 1e-9 * work.bytes / seconds,
                gflop_s=None if work is None else 1e-9 * work.flops / seconds,
                floor_us=floors.get(bound),
                bound=bound,
                ceiling_gb_s=ceilings.gb_s,
                ceiling_gflop_s=ceilings.gflop_s,
                **about,
            )
        )
    return rows


def measure_ceilings(device: torch.device) -> Ceilings:
    """By a copy of 1 GiB, and a product of 8192 x 8192 float32 matrices."""
    source = torch.ones(COPY_BYTES // 4, device=device)
    target = torch.empty_like(source)
    a, b, product = (torch.ones(MATRIX, MATRIX, device=device) for _ in range(3))
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")  # TF32 rounds to 11 bits: another arithmetic
    try:
        copies, products = time_groups(
            [
                Probe(lambda: target.copy_(source), device_clock),
                Probe(lambda: torch.mm(a, b, out=product), device_clock),
            ],
            CEILING_GROUPS,
        )
    finally:
        torch.set_float32_matmul_precision(before)
    return Ceilings(2 * COPY_BYTES / (1e6 * copies.median_ms), 2 * MATRIX**3 / (1e6 * products.median_ms))


class Profiled(NamedTuple):
    """A call to profile."""

    case: str
    run: Callable[[], Results]
    models: Mapping[str, Callable[[Any], Work]]
    counts: Counts | MeshCounts


def profiled_cases(device: torch.device, seed: int) -> list[Profiled]:
    """An image with its backward pass at two sizes, posing, and visibility."""
    cases = []
    visibility = OPERATORS["depth_visibility"]
    for size in (512, 1024):
        scene = hand_scenes(size, seed)[0].to(device=device)
        signs = torch.randint(0, 2, (1, size, size, 3), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1
        run = with_gradients(RASTERIZATION, RASTERIZATION.call, scene, UNVALIDATED, (signs.to(device),))
        name = f"{size_name(HAND_GAUSSIANS, size)}, forward + backward"
        cases.append(Profiled(name, run, PICTURE_KERNELS, count(scene)))
    avatar, mesh = avatar_scene(512, seed, device), hand_scenes(448, seed)[1].to(device=device)
    cases.append(Profiled("posing 37k", posing(avatar)[0].run, MESH_KERNELS, count_avatar(avatar)))
    run_visibility = lambda: Results(forward(visibility.call, mesh, UNVALIDATED))  # noqa: E731
    cases.append(Profiled("visibility at 448 x 448", run_visibility, MESH_KERNELS, count_mesh(mesh)))
    return cases


def measure_roofline(device: torch.device, seed: int = 0, progress: Progress = silent) -> list[KernelRow]:
    """Rows of every kernel of every case, the longest first in each.

    Args:
        device: A CUDA device.
        seed: Seed of the scenes.
        progress: Called after every case.
    """
    ceilings = measure_ceilings(device)
    about = provenance(device)
    cases = profiled_cases(device, seed)
    rows: list[KernelRow] = []
    for done, case in enumerate(cases):
        rows += assess(case.case, kernel_times(case.run), case.models, case.counts, ceilings, about)
        progress("roofline", done + 1, len(cases))
    return rows
