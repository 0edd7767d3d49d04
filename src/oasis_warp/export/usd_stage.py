"""OpenUSD stages as files, and Gaussians in them; needs the optional package usd-core.

Gaussians have the schema ParticleField3DGaussianSplat, from version 26.3 on.
"""

import importlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_files
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import posed_splats

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
