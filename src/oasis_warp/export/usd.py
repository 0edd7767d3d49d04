"""OpenUSD stages: Gaussians, and the avatar's skin as a UsdSkel mesh with blend shapes; needs the package usd-core.

Gaussians have the schema ParticleField3DGaussianSplat, from version 26.3 on.
"""

import importlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_files
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export import texture
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.skinned_gltf import KEYS, SECONDS, clip_angles
from oasis_warp.export.splats import posed_splats
from oasis_warp.export.surface_mesh import SkinnedMesh, skinned_mesh
from oasis_warp.hand.webxr_rig import Rig, local_bind, local_quats

ENDINGS = (".usdc", ".usda", ".usd", ".usdz")


def usd(path: Path, module: str) -> Any:
    """A module of `pxr`.

    Raises:
        InputError: usd-core is not installed.
    """
    try:
        return importlib.import_module(f"pxr.{module}")
    except ImportError as error:
        raise InputError(
            f"{path}: writing USD needs the package usd-core; install it: pip install 'oasis-warp[usd]'."
        ) from error


def new_stage(path: Path) -> tuple[Any, str]:
    """An empty stage in metres with y up, and the path of its only root, "/hand", which the writer defines.

    Raises:
        InputError: usd-core is not installed.
    """
    Usd, UsdGeom = usd(path, "Usd"), usd(path, "UsdGeom")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage, "/hand"


def write_stage(stage: Any, path: Path, beside: dict[str, bytes]) -> None:
    """Write a stage and the files whose names it holds: beside it, or in a .usdz inside, atomically.

    Raises:
        InputError: a file cannot be written.
    """
    packed = path.suffix.lower() == ".usdz"
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / ("hand.usdc" if packed else f"hand{path.suffix.lower()}")
        stage.GetRootLayer().Export(str(layer))
        if packed:
            for name, data in beside.items():
                (layer.parent / name).write_bytes(data)
            package = layer.with_suffix(".usdz")
            usd(path, "UsdUtils").CreateNewUsdzPackage(str(layer), str(package))
            write_files({path: package.read_bytes()})
        else:
            write_files({path: layer.read_bytes(), **{path.with_name(name): data for name, data in beside.items()}})


def vec3f(path: Path, values: np.ndarray) -> Any:
    """Rows of three as USD has them."""
    return usd(path, "Vt").Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def quatf(path: Path, quats: np.ndarray) -> Any:
    """Quaternions wxyz as USD has them."""
    return usd(path, "Vt").QuatfArray.FromNumpy(np.ascontiguousarray(quats[:, [1, 2, 3, 0]], np.float32))


EXTENT = 3
"""Standard deviations around the means that the bounding box holds."""


def write_splat_usd(request: ExportRequest, path: Path) -> None:
    """Scales [m], opacities in [0, 1] and the constant harmonic of sRGB; y up.

    Raises:
        InputError: usd-core is missing, a value is not finite, or `path` cannot be written.
    """
    UsdVol, UsdGeom, Vt = (usd(path, module) for module in ("UsdVol", "UsdGeom", "Vt"))
    means, quats, scales, opacities, colors = (part.numpy() for part in posed_splats(request))
    stage, root = new_stage(path)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{root}/splats")
    field.CreatePositionsAttr(vec3f(path, means))
    field.CreateOrientationsAttr(quatf(path, quats))
    field.CreateScalesAttr(vec3f(path, scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(np.ascontiguousarray(opacities, np.float32)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(vec3f(path, (colors - 0.5) / SH_C0))
    reach = EXTENT * scales.max()
    field.CreateExtentAttr(vec3f(path, np.stack([means.min(0) - reach, means.max(0) + reach])))
    write_stage(stage, path, {})


def write_skinned_usd(request: ExportRequest, path: Path) -> None:
    """The mesh of `write_skinned_gltf` with its clip "poses", or with `pose` in that pose; NAME_skin.png beside it.

    Names of joints have _ for WebXR's -, which no USD path may hold.

    Raises:
        InputError: usd-core is missing, a value is not finite, or a file cannot be written.
    """
    Usd, UsdSkel = usd(path, "Usd"), usd(path, "UsdSkel")
    made = skinned_mesh(request.avatar)
    stage, root = new_stage(path)
    stage.SetTimeCodesPerSecond(KEYS / SECONDS)
    skel_root = UsdSkel.Root.Define(stage, root)
    stage.SetDefaultPrim(skel_root.GetPrim())
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/skeleton")
    joints = _joint_paths(made.rig)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateJointNamesAttr(list(made.rig.names))
    skeleton.CreateBindTransformsAttr(_matrices(path, made.rig.bind))
    skeleton.CreateRestTransformsAttr(_matrices(path, local_bind(made.rig)))
    shapes = [name.replace(" ", "_") for name in made.corrective_names]
    animation = UsdSkel.Animation.Define(stage, f"{root}/skeleton/poses")
    animation.CreateJointsAttr(joints)
    animation.CreateBlendShapesAttr(shapes)
    animation.CreateTranslationsAttr(vec3f(path, local_bind(made.rig)[:, :3, 3].numpy()))
    animation.CreateScalesAttr(usd(path, "Vt").Vec3hArray(len(joints), usd(path, "Gf").Vec3h(1, 1, 1)))
    clip = clip_angles(request.avatar)["poses"] if request.pose is None else request.pose.angles[None].to(made.points)
    quats = local_quats(made.rig, made.hand, made.rest, clip, request.avatar.side).numpy()
    weights = made.corrective_weights(clip).tolist()
    rotations, bends = animation.CreateRotationsAttr(), animation.CreateBlendShapeWeightsAttr()
    for frame in range(len(clip)):
        time = Usd.TimeCode(frame) if len(clip) > 1 else Usd.TimeCode.Default()
        rotations.Set(quatf(path, quats[frame]), time)
        bends.Set(weights[frame], time)
    if len(clip) > 1:
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(clip) - 1)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = _mesh(stage, f"{root}/skin", path, made)
    _bind(stage, mesh, skeleton, path, made, shapes)
    pictures = texture.bake_material(request, texture.SIZE)
    files = {name: f"{path.stem}_{name}.png" for name in pictures}
    _material(stage, mesh, root, path, files)
    write_stage(stage, path, {files[name]: data for name, data in pictures.items()})


def _joint_paths(rig: Rig) -> list[str]:
    paths: list[str] = []
    for name, parent in zip(rig.names, rig.parents, strict=True):
        plain = name.replace("-", "_")
        paths.append(plain if parent < 0 else f"{paths[parent]}/{plain}")
    return paths


def _matrices(path: Path, matrices: torch.Tensor) -> Any:
    """USD multiplies rows from the left."""
    Gf = usd(path, "Gf")
    return [Gf.Matrix4d(*matrix.T.double().flatten().tolist()) for matrix in matrices]


def _mesh(stage: Any, at: str, path: Path, made: SkinnedMesh) -> Any:
    UsdGeom, Sdf, Vt = (usd(path, module) for module in ("UsdGeom", "Sdf", "Vt"))
    mesh = UsdGeom.Mesh.Define(stage, at)
    points, faces = made.points.numpy(), made.mesh.faces.numpy().astype(np.int32)
    mesh.CreatePointsAttr(vec3f(path, points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    mesh.CreateNormalsAttr(vec3f(path, made.normals.numpy()))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(vec3f(path, np.stack([points.min(0), points.max(0)])))
    place = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    place.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(made.mesh.uv.numpy(), np.float32)))
    return mesh


def _bind(stage: Any, mesh: Any, skeleton: Any, path: Path, made: SkinnedMesh, shapes: list[str]) -> None:
    UsdSkel, Gf, Vt = (usd(path, module) for module in ("UsdSkel", "Gf", "Vt"))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    n = made.weights.shape[1]
    joints = made.joints.numpy().astype(np.int32).ravel()
    binding.CreateJointIndicesPrimvar(False, n).Set(Vt.IntArray.FromNumpy(joints))
    binding.CreateJointWeightsPrimvar(False, n).Set(Vt.FloatArray.FromNumpy(made.weights.numpy().ravel()))
    targets = []
    for name, offsets in zip(shapes, made.correctives.numpy(), strict=True):
        shape = UsdSkel.BlendShape.Define(stage, mesh.GetPath().AppendChild(name))
        shape.CreateOffsetsAttr(vec3f(path, offsets))
        shape.CreateNormalOffsetsAttr(vec3f(path, np.zeros_like(offsets)))
        targets.append(shape.GetPath())
    binding.CreateBlendShapesAttr(shapes)
    binding.CreateBlendShapeTargetsRel().SetTargets(targets)


def _material(stage: Any, mesh: Any, root: str, path: Path, files: dict[str, str]) -> None:
    UsdShade, Sdf = usd(path, "UsdShade"), usd(path, "Sdf")
    kinds = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, f"{root}/material")

    def shader(name: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"{root}/material/{name}")
        made.CreateIdAttr(kind)
        return made

    place, surface = shader("st", "UsdPrimvarReader_float2"), shader("surface", "UsdPreviewSurface")
    place.CreateInput("varname", kinds.String).Set("st")
    at = place.CreateOutput("result", kinds.Float2)

    def picture(name: str, space: str) -> Any:
        image = shader(name, "UsdUVTexture")
        image.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(files[name]))
        image.CreateInput("sourceColorSpace", kinds.Token).Set(space)
        image.CreateInput("st", kinds.Float2).ConnectToSource(at)
        return image

    color = picture("skin", "sRGB").CreateOutput("rgb", kinds.Float3)
    if "normal" in files:
        surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(color)
        normal, rough = picture("normal", "raw"), picture("roughness", "raw")
        normal.CreateInput("scale", kinds.Float4).Set((2, 2, 2, 1))
        normal.CreateInput("bias", kinds.Float4).Set((-1, -1, -1, 0))
        surface.CreateInput("normal", kinds.Normal3f).ConnectToSource(normal.CreateOutput("rgb", kinds.Float3))
        surface.CreateInput("roughness", kinds.Float).ConnectToSource(rough.CreateOutput("g", kinds.Float))
    else:
        surface.CreateInput("emissiveColor", kinds.Color3f).ConnectToSource(color)
        surface.CreateInput("diffuseColor", kinds.Color3f).Set((0, 0, 0))
    surface.CreateInput("metallic", kinds.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
