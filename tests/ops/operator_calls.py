"""Calls of every operator in all their variants, for the laws that all of them obey."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from rasterization_scenes import covariances, ordinary_scene
from torch import Tensor

from oasis_warp import ops
from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import DECLARATIONS
from oasis_warp.ops import projection as projection_module

N_POSES = 9
PARENTS = (-1, 0, 1, 0, 3)
PROJECTION = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3}


def mesh(seed, n, dtype):
    """A rumpled grid of n x n cells, at rest and posed."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(n + 1.0), torch.arange(n + 1.0), indexing="ij")
    flat = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    rest = flat + 0.2 * torch.randn(flat.shape, generator=generator)
    posed = rest * torch.tensor([1.2, 0.9, 1.0]) + 0.3 * torch.randn(flat.shape, generator=generator)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    return rest.to(dtype), posed.to(dtype), faces


class Call(NamedTuple):
    """A call of an operator; calling it with other float tensors in place of `inputs` gives the results."""

    operator: str
    arguments: dict[str, Any]
    custom_ops: tuple[str, ...]
    """In the order in which they run."""
    function: Callable[..., tuple[Tensor, ...]]
    """Of `inputs`, to the float results."""

    @property
    def names(self) -> list[str]:
        """The arguments that receive gradients."""
        return differentiable(self.operator, self.arguments)

    @property
    def inputs(self) -> list[Tensor]:
        """The tensors of `names`."""
        return [self.arguments[name] for name in self.names]

    def leaves(self) -> list[Tensor]:
        """Copies of `inputs` that require a gradient."""
        return [tensor.clone().requires_grad_() for tensor in self.inputs]


READ = {
    "rasterization": lambda out: (*out[:2], out[2]["means2d"]),
    "depth_visibility": lambda seen: (seen.visibility, seen.depth_map.clamp_max(1e3)),  # inf: no surface
    "project": lambda projection: projection[:3],
    "spherical_harmonics": lambda values: (values,),
}
"""From what an operator returns to a tuple of float tensors, where this is not all of it."""


def differentiable(operator, arguments):
    declaration = projection_module._OPERATOR if operator == "project" else DECLARATIONS[operator]
    return [name for name in declaration.differentiable if isinstance(arguments.get(name), Tensor)]


def call_of(operator, arguments, custom_ops):
    """The `Call` with these keyword arguments."""
    names = differentiable(operator, arguments)
    public = projection_module.project if operator == "project" else getattr(ops, operator)
    read = READ.get(operator, lambda out: tuple(part for part in out if part is not None))

    def function(*inputs):
        given = dict(arguments)
        for name, tensor in zip(names, inputs, strict=True):
            given[name] = tensor
        return read(public(**given))

    return Call(operator, arguments, custom_ops or (operator,), function)


def calls(seed=0, n=4, dtype=torch.float32, *, empty=False, device="cpu", validate=True, n_poses=N_POSES):
    """All calls by name, "operator variant": meshes of n x n cells, and about n^2 of all else, or none if `empty`."""
    generator = torch.Generator().manual_seed(seed)
    rest, posed, faces = (part.to(device) for part in mesh(seed, n, dtype))
    n_vertices, n_faces = len(rest), len(faces)
    made = {}

    def normal(*shape):
        return torch.randn(*shape, generator=generator).to(device, dtype)

    def unit(*shape):
        return torch.nn.functional.normalize(normal(*shape), dim=-1)

    def add(name, arguments, *custom_ops):
        made[name] = call_of(name.split()[0], arguments | {"validate": validate}, custom_ops)

    # Posing, in one pose and in several.
    face_index = torch.randint(n_faces, (0 if empty else n_faces + 3,), generator=generator).to(device)
    vertex_index = torch.randint(n_vertices, (0 if empty else n_vertices // 2,), generator=generator).to(device)
    q, p, k = len(face_index), len(vertex_index), 0 if empty else n * n + 2
    bones = {
        "angles": normal(4, 3), "orientation": to_matrix(normal(4)), "translation": normal(3), "joints": normal(5, 3),
        "axes": unit(5, 3, 3), "parents": PARENTS,
    }  # fmt: skip
    add("bone_transforms", bones)
    many = {
        "angles": normal(n_poses, 4, 3), "orientation": to_matrix(normal(n_poses, 4)),
        "translation": normal(n_poses, 3),
    }  # fmt: skip
    add("bone_transforms poses", bones | many)
    bent = {"rest_vertices": rest, "posed_vertices": posed, "faces": faces}
    add("face_rotations", bent)
    many_posed = {"posed_vertices": posed + 0.1 * normal(n_poses, n_vertices, 3)}
    add("face_rotations poses", bent | many_posed)
    on_faces = {
        "posed_vertices": posed, "faces": faces, "face_index": face_index, "barycentrics": normal(q, 3).softmax(-1),
        "vertex_quats": unit(n_vertices, 4), "area_ratio": normal(n_faces).exp(), "quats": normal(q, 4),
        "scales": normal(q, 3).exp(),
    }  # fmt: skip
    add("pose_on_mesh faces", on_faces | {"scale_law": "area"})
    on_both = on_faces | {
        "vertex_index": vertex_index, "quats": normal(p + q, 4), "scales": normal(p + q, 3).exp(),
        "offsets": normal(p, 3), "vertex_area_ratio": normal(n_vertices).exp(),
    }  # fmt: skip
    add("pose_on_mesh", on_both)
    many = many_posed | {
        "vertex_quats": unit(n_poses, n_vertices, 4), "area_ratio": normal(n_poses, n_faces).exp(),
        "vertex_area_ratio": normal(n_poses, n_vertices).exp(),
    }  # fmt: skip
    add("pose_on_mesh poses", on_both | many)
    stretched = {name: on_faces[name] for name in ("face_index", "barycentrics", "quats", "scales")}
    add("pose_on_mesh_covars", bent | stretched)
    points = {"means": normal(k, 3), "covars": None, "weights": normal(k, 5).softmax(-1)}
    solid = points | {"covars": normal(k, 3, 3)}
    add("skin points", points | {"weights": normal(k, 33).softmax(-1), "transforms": normal(33, 3, 4)})
    add("skin", solid | {"transforms": normal(5, 3, 4)})
    add("skin rotation_only", solid | {"transforms": normal(5, 4, 4), "rotation_only": True})
    correctives = {"displacements": normal(k, 3, 6), "strengths": normal(6)}
    add("skin correctives", points | correctives | {"transforms": normal(5, 3, 4)})
    add("skin poses", solid | correctives | {"transforms": normal(n_poses, 5, 4, 4), "strengths": normal(n_poses, 6)})

    # Pictures.
    ahead = rest - torch.tensor([0.5 * n, 0.5 * n, -n - 2.0]).to(rest)
    n_points = 0 if empty else n_vertices // 2
    known = torch.full((n_points,), -1, device=device)
    known[::3] = 1
    seen = {
        "points": ahead[:n_points] + 0.01, "vertices": ahead, "faces": faces, "viewmat": torch.eye(4).to(rest),
        "K": torch.tensor([[10.0, 0, 8], [0, 10, 8], [0, 0, 1]]).to(rest), "width": 16, "height": 16, "tau": 0.1,
    }  # fmt: skip
    add("depth_visibility", seen | {"point_vertices": known})
    add("depth_visibility poses", seen | {"vertices": ahead + 0.1 * normal(n_poses, n_vertices, 3)})
    add("spherical_harmonics", {"directions": normal(k, 3), "coefficients": normal(k, 16, 3), "degree": 2})
    scene = ordinary_scene(seed + 1, n=k, width=17, height=15).to(device, dtype)
    cloud = {name: getattr(scene, name) for name in ("means", "opacities", "viewmats", "Ks", "width", "height")}
    axes, whole = {"quats": scene.quats, "scales": scene.scales}, {"quats": None, "scales": None}
    whole["covars"] = covariances(scene)
    colored = {"colors": scene.colors, "backgrounds": scene.backgrounds}
    add("project", cloud | axes | PROJECTION)
    add("project covars", cloud | whole | PROJECTION)
    add("rasterization", cloud | axes | colored | {"render_mode": "RGB+ED"}, "project", "blend")
    of_gsplat = {"rasterize_mode": "antialiased", "camera_model": "ortho"}
    add("rasterization antialiased", cloud | axes | colored | of_gsplat, "project", "blend")
    harmonics = {"colors": 0.3 * normal(k, 9, 3), "sh_degree": 1}
    add("rasterization harmonics", cloud | whole | harmonics, "sh_to_rgb", "project", "blend")
    return made


NAMES = tuple(calls())
ONE_OF_EACH = (
    "bone_transforms poses", "face_rotations poses", "pose_on_mesh poses", "pose_on_mesh_covars", "skin poses",
    "depth_visibility", "spherical_harmonics", "rasterization", "rasterization harmonics",
)  # fmt: skip
"""A call of each custom op, and of all its inputs."""


def weights_of(out):
    """Random weights for results."""
    generator = torch.Generator().manual_seed(5)
    return [torch.randn(part.shape, generator=generator).to(part) for part in out]


def loss_of(out):
    """A random weighting of results."""
    return sum((part * w).sum() for part, w in zip(out, weights_of(out), strict=True) if part.requires_grad)


def gradients(out, leaves):
    """Of a random weighting of results."""
    return list(torch.autograd.grad(loss_of(out), leaves))


def results(name, function=None, transform=lambda leaf: leaf, **which):
    """Results of a call, and gradients; `function` in place of the call's, `transform` of its inputs."""
    call = calls(**which)[name]
    leaves = call.leaves()
    out = (function or call.function)(*map(transform, leaves))
    return [part.detach() for part in out] + gradients(out, leaves)


def assert_same_bits(some, others, what=""):
    for a, b in zip(some, others, strict=True):
        assert torch.equal(a, b), what
