"""gsplat as a peer, where it is installed: six cube faces in one call, stitched as ours are. CUDA only.

It never ran where this was written (no GPU); its options follow gsplat's documentation of `rasterization`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.cases import Case
from pansplat.constants import FILTER_VARIANCE
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.cubemap import face_poses
from pansplat.geometry.pose import invert_pose
from pansplat.rendering.image_planes import stitch_faces


def render_gsplat(
    case: Case, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], *, near: float
) -> Float[Tensor, "channel height width"]:
    """A panorama of six faces by gsplat, classic kernel and z order.

    Raises:
        InputError: gsplat is not installed, or draws no such picture.
    """
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise InputError("backend 'gsplat' needs the package gsplat; install it, or leave it out") from error
    if not case.possible or case.face_size is None:
        raise InputError("backend 'gsplat' draws layout 'cubemap' with kernel 'ewa' and order 'z' only")
    device, side = gaussians.means.device, case.face_size
    half = 0.5 * side
    intrinsics = torch.tensor(((half, 0, half), (0, half, half), (0, 0, 1)), device=device)
    colors, _, _ = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=gaussians.harmonics,
        viewmats=invert_pose(face_poses(cam2world.double())).float().to(device),
        Ks=intrinsics.expand(6, 3, 3),
        width=side,
        height=side,
        near_plane=near,
        eps2d=FILTER_VARIANCE[case.filter],
        sh_degree=gaussians.degree,
        packed=False,
        rasterize_mode="antialiased" if case.filter == "angular" else "classic",
    )
    return stitch_faces(colors.permute(0, 3, 1, 2), case.size, stitching=case.stitching)
