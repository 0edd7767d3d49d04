"""Gaussians in OpenUSD: the schema ParticleField3DGaussianSplat, from version 26.3 on."""

from pathlib import Path

import numpy as np

from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import posed_splats
from oasis_warp.export.usd_stage import new_stage, quatf, usd, vec3f, write_stage

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
