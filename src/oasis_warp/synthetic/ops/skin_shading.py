"""Deferred shading of a posed, textured hand: light on its vertices, then the colours of a picture's pixels."""

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import skin_light, skin_shading
from oasis_warp.core.checks import check_positive, check_shape
from oasis_warp.ops._runtime.declaration import Array, Operator
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view
from oasis_warp.ops.depth_map import DepthMap

LIGHT_WIDTHS = (1.25e-3, 0.45e-3, 0.25e-3)
"""Scattering distances of red, green and blue light in skin: standard deviations [m]."""
LIGHT_REACH = 3e-3
"""Depth step that light does not cross [m]."""


class SurfaceState(NamedTuple):
    """Of a batch of posed meshes."""

    normals: Float[Tensor, "B V 3"]
    """Unit, area-weighted; zero where no face is."""
    areas: Float[Tensor, "B V"]
    """Twice the area of the faces around each vertex."""


class Lamps(NamedTuple):
    """Round lamps, with the depth buffers that they see; L lamps an image. A black one is none."""

    positions: Float[Tensor, "B L 3"]
    colors: Float[Tensor, "B L 3"]
    """Irradiance over pi on a surface that faces the lamp at distance `ranges`, linear RGB."""
    ranges: Float[Tensor, "B L"]
    spreads: Float[Tensor, "B L"]
    """Radius over distance."""
    viewmats: Float[Tensor, "B L 4 4"]
    focals: Float[Tensor, "B L"]
    """Of the depth buffers [px], whose axis is their middle."""
    depths: Float[Tensor, "B L M M"]


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
    """Of the faces of skin, which come first."""


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


def _surface_state(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    batch, n = vertices.shape[:2]
    index = incidence("faces", faces, n, "vertices")
    normals, areas = torch.empty_like(vertices), vertices.new_empty((batch, n))
    inputs = [
        view(vertices.contiguous(), wp.vec3f), *map(view, index), view(normals, wp.vec3f), view(areas),
    ]  # fmt: skip
    launch_ranges(skin_light.surface_state, even_cuts(batch * n), inputs, like=vertices)
    return normals, areas


def _surface_state_fake(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    return torch.empty_like(vertices), vertices.new_empty(vertices.shape[:2])


_SURFACE_STATE = Operator(
    "surface_state",
    _surface_state,
    _surface_state_fake,
    inputs={"vertices": Array("B V 3"), "faces": Array("F 3", index="V")},
    outputs={"normals": "B V 3", "areas": "B V"},
    public=False,
)


@torch.no_grad()
def surface_state(vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> SurfaceState:
    """Vertex normals and the areas around vertices of float32 meshes, summed in a fixed order.

    Raises:
        ValueError: a wrong shape or index.
    """
    _SURFACE_STATE.check(vertices=vertices, faces=faces)
    return SurfaceState(*_SURFACE_STATE(vertices, faces))


def _smooth(values: Tensor, faces: Tensor) -> Tensor:
    index = incidence("faces", faces, values.shape[1], "vertices")
    values = values.contiguous()
    out = torch.empty_like(values)
    inputs = [view(values), *map(view, index), view(out)]
    launch_ranges(skin_light.smooth, even_cuts(values.numel()), inputs, like=values)
    return out


def _smooth_fake(values: Tensor, faces: Tensor) -> Tensor:
    return torch.empty_like(values)


_SMOOTH = Operator(
    "smooth_over_faces",
    _smooth,
    _smooth_fake,
    inputs={"values": Array("B V C"), "faces": Array("F 3", index="V")},
    outputs={"smooth": "B V C"},
    public=False,
)


@torch.no_grad()
def smooth_over_faces(values: Float[Tensor, "B V C"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V C"]:
    """Mean over the corners of the faces around each vertex, itself counted once per face; lonely vertices stay.

    Raises:
        ValueError: a wrong shape or index.
    """
    _SMOOTH.check(values=values, faces=faces)
    return _SMOOTH(values, faces)


def _sky_transfer(
    vertices: Tensor, normals: Tensor, directions: Tensor, viewmats: Tensor, focals: Tensor, depths: Tensor,
    lift: float, n_lit: int,
) -> Tensor:  # fmt: skip
    batch, n = vertices.shape[:2]
    out = vertices.new_zeros((batch, n, 10))
    inputs = [
        view(vertices.contiguous(), wp.vec3f), view(normals.contiguous(), wp.vec3f),
        view(directions.contiguous(), wp.vec3f), view(viewmats.contiguous(), wp.mat44f), view(focals.contiguous()),
        view(depths.contiguous()), lift, n_lit, view(out),
    ]  # fmt: skip
    launch_ranges(skin_light.sky_transfer, even_cuts(batch * n_lit), inputs, like=vertices)
    return out


def _sky_transfer_fake(vertices, normals, directions, viewmats, focals, depths, lift, n_lit):
    return vertices.new_empty((*vertices.shape[:2], 10))


_SKY_TRANSFER = Operator(
    "sky_transfer",
    _sky_transfer,
    _sky_transfer_fake,
    inputs={
        "vertices": Array("B V 3"), "normals": Array("B V 3"), "directions": Array("D 3"),
        "viewmats": Array("B D 4 4"), "focals": Array("B"), "depths": Array("B D M M"),
    },
    outputs={"transfer": "B V 10"},
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
        normals: Of `surface_state`.
        directions: Unit vectors spread evenly over the sphere, towards the sky, [D, 3].
        viewmats: To the frame of a far camera in each direction that looks back at the mesh, [B, D, 4, 4].
        focals: Of those cameras [px], whose axis is the middle of the buffer, [B].
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
    return _SKY_TRANSFER(vertices, normals, directions, viewmats, focals, depths, lift, n_lit)


def _addresses(pages: list[Tensor], device: torch.device) -> Tensor:
    """Where each begins, as a tensor on their device."""
    host = torch.tensor([page.data_ptr() for page in pages])
    return host.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else host


def _shade(
    face_ids: Tensor, barycentrics: Tensor, depths: Tensor, focals: Tensor, samples: int, n_hand_faces: int, ring: int,
    vertices: Tensor, faces: Tensor, normals: Tensor, transfer: Tensor, stretch: Tensor,
    materials: Tensor, looks: Tensor, pages: list[Tensor], uv: Tensor, uv_faces: Tensor, tones: Tensor,
    texels_a_pixel: Tensor, sky: Tensor, lamp_positions: Tensor, lamp_colors: Tensor, lamp_ranges: Tensor,
    lamp_spreads: Tensor, lamp_viewmats: Tensor, lamp_focals: Tensor, lamp_depths: Tensor, seeds: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    batch, rows, columns = face_ids.shape
    light, tone, mirrored = (vertices.new_zeros((batch, rows, columns, 3)) for _ in range(3))
    vec3 = lambda t: view(t.contiguous(), wp.vec3f)  # noqa: E731
    whole = lambda t: view(t.to(torch.int32).contiguous())  # noqa: E731
    ids, kinds, table = view(face_ids), whole(materials), incidence("faces", faces, vertices.shape[1], "vertices").table
    cuts = even_cuts(batch * rows * columns)
    launch_ranges(
        skin_shading.shade,
        cuts,
        [
            ids, vec3(barycentrics), vec3(vertices), vec3(normals), view(transfer.contiguous()),
            view(stretch.contiguous()), view(table), kinds, view(uv.contiguous(), wp.vec2f), whole(uv_faces),
            view(_addresses(pages, vertices.device)), *pages[0].shape[:2], view(looks.contiguous()), vec3(tones),
            vec3(sky), vec3(lamp_positions), vec3(lamp_colors), view(lamp_ranges.contiguous()),
            view(lamp_spreads.contiguous()), view(lamp_viewmats.contiguous(), wp.mat44f),
            view(lamp_focals.contiguous()), view(lamp_depths.flatten(0, 1).contiguous()),
            view(texels_a_pixel.contiguous()), whole(seeds),
            view(light, wp.vec3f), view(tone, wp.vec3f), view(mirrored, wp.vec3f),
        ],
        like=vertices,
    )  # fmt: skip
    depth, focal = view(depths.contiguous()), view(focals.contiguous())
    between = torch.zeros_like(light)
    for vertical, source, target in ((0, light, between), (1, between, light)):
        inputs = [ids, depth, kinds, focal, wp.vec3f(*LIGHT_WIDTHS), LIGHT_REACH, vertical,
                  view(source, wp.vec3f), view(target, wp.vec3f)]  # fmt: skip
        launch_ranges(skin_shading.scatter, cuts, inputs, like=vertices)
    size = (batch, rows // samples, columns // samples)
    color, (alpha, mask, nearest) = vertices.new_empty((*size, 3)), (vertices.new_empty(size) for _ in range(3))
    launch_ranges(
        skin_shading.resolve,
        even_cuts(alpha.numel()),
        [
            ids, depth, kinds, n_hand_faces, ring, view(light, wp.vec3f), view(tone, wp.vec3f),
            view(mirrored, wp.vec3f), view(color, wp.vec3f), view(alpha), view(mask), view(nearest),
        ],
        like=vertices,
    )  # fmt: skip
    return color, alpha, mask, nearest, tone


def _shade_fake(face_ids, barycentrics, depths, focals, samples, n_hand_faces, ring, vertices, *_):
    size = (len(face_ids), face_ids.shape[1] // samples, face_ids.shape[2] // samples)
    color, fine = (vertices.new_empty((*shape, 3)) for shape in (size, face_ids.shape))
    return color, *(vertices.new_empty(size) for _ in range(3)), fine


_SHADE = Operator(
    "shade_skin",
    _shade,
    _shade_fake,
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
    outputs={"color": "B R S 3", "alpha": "B R S", "mask": "B R S", "depth": "B R S", "albedo": "B H W 3"},
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
        normals: Of `surface_state`.
        transfer: Of `sky_transfer`.
        stretch: Area of the posed over that of the resting surface around each vertex.
        texture: Of the skin.
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
    return Shaded(
        *_SHADE(
            seen.face_ids, seen.barycentrics, seen.depth, focals, samples, n_hand_faces, ring, vertices, faces, normals,
            transfer, stretch, worn.materials, worn.looks, *texture, tones, texels_a_pixel, sky, *lamps, seeds,
        )
    )  # fmt: skip
