"""Deferred shading of a posed, textured hand: light on its vertices, then the colours of a picture's pixels."""

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import skin_light, skin_shading
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops._runtime.launch import launch_ranges, view
from oasis_warp.ops.checks import check_positive, check_shape
from oasis_warp.ops.depth_map import DepthMap
from oasis_warp.synthetic.ops.views import Lamps, integers, matrices, scalars, vectors

LIGHT_WIDTHS = (1.25e-3, 0.45e-3, 0.25e-3)
"""Scattering distances of red, green and blue light in skin: standard deviations [m]."""
LIGHT_REACH = 3e-3
"""Depth step that light does not cross [m]."""


class SurfaceState(NamedTuple):
    """Normals and areas of a batch of posed meshes."""

    normals: Float[Tensor, "B V 3"]
    """Unit, area-weighted; zero where no face is."""
    areas: Float[Tensor, "B V"]
    """Twice the area of the faces around each vertex."""


class Worn(NamedTuple):
    """What covers the skin: one row for each material of the faces, material 0 being skin."""

    materials: Int[Tensor, "F"]
    """int32."""
    looks: Float[Tensor, "B T 6"]
    """Red, green, blue (linear), roughness, metal 0 to 1, cloth 0 or 1."""


class Texture(NamedTuple):
    """Skin textures of several people."""

    pages: list[Float[Tensor, "Y X 8"]]
    """One an image, float16, all of one size: linear RGB, height, fold, wrinkle [mm], roughness, oil (see
    `oasis_warp.synthetic.skin_texture`). They are read where they lie: images may share one."""
    uv: Float[Tensor, "U 2"]
    """Texels, centres at .5."""
    uv_faces: Int[Tensor, "S 3"]
    """Texture corners of the faces of skin; these faces come first."""


class Shaded(NamedTuple):
    """A batch of pictures, linear light."""

    color: Float[Tensor, "B H W 3"]
    """Multiplied by alpha."""
    alpha: Float[Tensor, "B H W"]
    mask: Float[Tensor, "B H W"]
    """Share of each pixel that is hand, without forearm and clothes."""
    depth: Float[Tensor, "B H W"]
    """Nearest surface of each pixel [m], +inf where there is none."""
    albedo: Float[Tensor, "B Y X 3"]
    """Diffuse reflectance of each sub-pixel, linear RGB; 0 where no surface is."""


_SURFACE_STATE = Declaration(
    "surface_state", inputs={"vertices": Array("B V 3"), "faces": Array("F 3", index="V")}, public=False
)


@torch.no_grad()
def surface_state(vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> SurfaceState:
    """Vertex normals and the areas around vertices of float32 meshes, summed in a fixed order.

    Raises:
        ValueError: a wrong shape or index.
    """
    sizes = _SURFACE_STATE.check(vertices=vertices, faces=faces)
    index = incidence("faces", faces, sizes["V"], "vertices")
    normals = torch.empty_like(vertices, memory_format=torch.contiguous_format)
    areas = vertices.new_empty(vertices.shape[:2])
    inputs = [vectors(vertices), *index, vectors(normals), areas]
    launch_ranges(skin_light.surface_state, areas.numel(), inputs, like=vertices)
    return SurfaceState(normals, areas)


_SKY_TRANSFER = Declaration(
    "sky_transfer",
    inputs={
        "vertices": Array("B V 3"), "normals": Array("B V 3"), "directions": Array("D 3"),
        "viewmats": Array("B D 4 4"), "focals": Array("B"), "depths": Array("B D M M"),
    },
    public=False,
)  # fmt: skip


@torch.no_grad()
def sky_transfer(
    vertices: Float[Tensor, "B V 3"],
    normals: Float[Tensor, "B V 3"],
    directions: Float[Tensor, "D 3"],
    viewmats: Float[Tensor, "B D 4 4"],
    focals: Float[Tensor, "B"],
    depths: Float[Tensor, "B D M M"],
    *,
    lift: float = 0.002,
    n_lit: int | None = None,
) -> Float[Tensor, "B V 10"]:
    """How each vertex sees light from all around: nine harmonics of its unhidden cosine lobe, and the unhidden share.

    The scalar product of the nine with a light's coefficients (order 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2) is
    the irradiance over pi (precomputed radiance transfer, Sloan et al. 2002).

    Args:
        vertices: float32 [B, V, 3] [m].
        normals: Normals of `surface_state`.
        directions: Unit vectors spread evenly over the sphere, towards the sky, [D, 3].
        viewmats: To the frame of a far camera in each direction that looks back at the mesh, [B, D, 4, 4].
        focals: Focal lengths of those cameras [px], [B]; their axis is the middle of the buffer.
        depths: What they see, [B, D, M, M].
        lift: Distance off the surface from which vertices look [m]; as much again is allowed in depth.
        n_lit: Number of leading vertices to compute; the rows of the others are 0.

    Raises:
        ValueError: wrong shapes, or a lift that is not positive.
    """
    sizes = _SKY_TRANSFER.check(
        vertices=vertices, normals=normals, directions=directions, viewmats=viewmats, focals=focals, depths=depths
    )
    check_positive("lift", lift)
    n_lit = sizes["V"] if n_lit is None else n_lit
    if not 0 <= n_lit <= sizes["V"]:
        raise ValueError(f"n_lit: expected 0 to {sizes['V']}, got {n_lit}.")
    out = vertices.new_zeros((*vertices.shape[:2], 10))
    inputs = [
        vectors(vertices), vectors(normals), vectors(directions), matrices(viewmats), scalars(focals), scalars(depths),
        lift, n_lit, out,
    ]  # fmt: skip
    launch_ranges(skin_light.sky_transfer, len(vertices) * n_lit, inputs, like=vertices)
    return out


def _addresses(pages: list[Tensor], device: torch.device) -> Tensor:
    """Where each begins, as a tensor on their device."""
    host = torch.tensor([page.data_ptr() for page in pages])
    return host.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else host


_SHADE = Declaration(
    "shade_skin",
    inputs={
        "seen.face_ids": Array("B H W", index="F", least=-1, hint="A batch, of one image at least."),
        "vertices": Array("B V 3"),
        "faces": Array("F 3", index="V"),
        "normals": Array("B V 3"),
        "transfer": Array("B V 10"),
        "stretch": Array("B V 1"),
        "worn.looks": Array(f"B T {int(skin_shading.MATERIAL_WORDS)}"),
        "sky": Array("B 9 3"),
        "lamps.depths": Array("B L M M"),
        "lamps.positions": Array("B L 3"),
    },
    public=False,
)


@torch.no_grad()
def shade_skin(
    seen: DepthMap,
    focals: Float[Tensor, "B"],
    samples: int,
    vertices: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "B V 3"],
    transfer: Float[Tensor, "B V 10"],
    stretch: Float[Tensor, "B V 1"],
    texture: Texture,
    worn: Worn,
    tones: Float[Tensor, "B 3"],
    texels_a_pixel: Float[Tensor, "B"],
    sky: Float[Tensor, "B 9 3"],
    lamps: Lamps,
    seeds: Int[Tensor, "B"],
    *,
    n_hand_faces: int,
    ring: int,
) -> Shaded:
    """Pictures of skin: textured relief, subsurface light, two-lobed gloss, soft shadows of lamps, hidden sky.

    The same values on every device, up to rounding, and in a batch as alone. Not differentiable.

    Args:
        seen: Depth map of the mesh at `samples` times the picture's size, in the camera's own frame, batched.
        focals: Focal length of that map [px].
        samples: Sub-pixels along a side of a pixel.
        vertices: In the camera's frame (x right, y down, z forward) [m], float32.
        faces: As drawn in `seen`.
        normals: Normals of `surface_state`.
        transfer: Transfer of `sky_transfer`.
        stretch: Area of the posed over that of the resting surface around each vertex.
        texture: Texture of the skin.
        worn: Materials of the faces and how they look.
        tones: Mean reflectance of each image's skin, linear RGB, for light that skin throws on skin.
        texels_a_pixel: Size of a sub-pixel on the hand: relief finer than that is left out.
        sky: Coefficients of the light from all around.
        lamps: The lamps.
        seeds: int32, of the weave of cloth.
        n_hand_faces: Number of leading faces that belong to the hand.
        ring: Material that counts as hand in the mask.

    Raises:
        ValueError: wrong shapes.
    """
    sizes = _SHADE.check(**{
        "seen.face_ids": seen.face_ids, "vertices": vertices, "faces": faces, "normals": normals, "transfer": transfer,
        "stretch": stretch, "worn.looks": worn.looks, "sky": sky, "lamps.depths": lamps.depths,
        "lamps.positions": lamps.positions,
    })  # fmt: skip
    if len(texture.pages) != sizes["B"]:
        raise ValueError(f"texture.pages: expected {sizes['B']}, one an image, got {len(texture.pages)}.")
    for page in texture.pages:
        check_shape("texture.pages", page, "Y", "X", 8, sizes=sizes)
        if page.dtype != torch.float16 or not page.is_contiguous() or page.device != vertices.device:
            raise ValueError("texture.pages: expected contiguous float16 on the device of the vertices.")
    if sizes["H"] % samples or sizes["W"] % samples:
        raise ValueError(f"samples: expected a divisor of {sizes['H']} and {sizes['W']}, got {samples}.")
    rows, columns = sizes["H"], sizes["W"]
    light, tone, mirrored = (vertices.new_zeros((sizes["B"], rows, columns, 3)) for _ in range(3))
    ids, kinds, table = seen.face_ids, integers(worn.materials), incidence("faces", faces, sizes["V"], "vertices")
    count = seen.face_ids.numel()
    inputs = [
        ids, vectors(seen.barycentrics), vectors(vertices), vectors(normals), scalars(transfer), scalars(stretch),
        table.table, kinds, view(texture.uv.contiguous(), wp.vec2f), integers(texture.uv_faces),
        _addresses(texture.pages, vertices.device), *texture.pages[0].shape[:2], scalars(worn.looks),
        vectors(tones), vectors(sky), lamps.struct(), scalars(texels_a_pixel), integers(seeds),
        vectors(light), vectors(tone), vectors(mirrored),
    ]  # fmt: skip
    launch_ranges(skin_shading.shade, count, inputs, like=vertices)
    depth, focal = scalars(seen.depth), scalars(focals)
    between = torch.zeros_like(light)
    for vertical, source, target in ((0, light, between), (1, between, light)):
        widths = wp.vec3f(*LIGHT_WIDTHS)
        inputs = [ids, depth, kinds, focal, widths, LIGHT_REACH, vertical, vectors(source), vectors(target)]
        launch_ranges(skin_shading.scatter, count, inputs, like=vertices)
    size = (sizes["B"], rows // samples, columns // samples)
    color, (alpha, mask, nearest) = vertices.new_empty((*size, 3)), (vertices.new_empty(size) for _ in range(3))
    inputs = [
        ids, depth, kinds, n_hand_faces, ring, vectors(light), vectors(tone), vectors(mirrored),
        vectors(color), alpha, mask, nearest,
    ]  # fmt: skip
    launch_ranges(skin_shading.resolve, alpha.numel(), inputs, like=vertices)
    return Shaded(color, alpha, mask, nearest, tone)
