"""gsplat's PyTorch path: image and gradients of a small scene on a CPU. Runs in the environment that `build.sh` makes.

    FOLDER/torch/bin/python pytorch_path.py SCENE.npz OUT.npz

The projection is gsplat's own. Its PyTorch rasteriser cannot run without CUDA: the pairs of pixels and Gaussians
come from a CUDA kernel. Here every pixel is blended with every Gaussian, by the same equations.
"""

import sys
import time

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from gsplat.cuda._torch_impl import (  # pyright: ignore[reportMissingImports]
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
)


def main(scene: str, out: str) -> None:
    """Render the scene, differentiate the L1 distance to its target, and write both."""
    data = dict(np.load(scene))
    names = ("means", "quats", "scales", "opacities", "colors")
    leaves = {name: torch.tensor(data[name], dtype=torch.float32, requires_grad=True) for name in names}
    viewmat, K = (torch.tensor(data[name], dtype=torch.float32)[None] for name in ("viewmat", "K"))
    width, height, times = int(data["width"]), int(data["height"]), []
    for _ in range(4):
        for leaf in leaves.values():
            leaf.grad = None
        start = time.perf_counter()
        image = render(leaves, viewmat, K, width, height)
        (image - torch.tensor(data["target"], dtype=torch.float32)).abs().mean().backward()
        times.append(1e3 * (time.perf_counter() - start))
    grads = {f"grad_{name}": leaf.grad.numpy() for name, leaf in leaves.items()}
    np.savez(out, image=image.detach().numpy(), ms=np.median(times[1:]), version=torch.__version__, **grads)


def render(leaves: dict, viewmat: torch.Tensor, K: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Return the image [height, width, 3]."""
    quats = leaves["quats"] / leaves["quats"].norm(dim=-1, keepdim=True)
    covars, _ = _quat_scale_to_covar_preci(quats, leaves["scales"], compute_preci=False)
    _, means2d, depths, conics, _ = _fully_fused_projection(leaves["means"], covars, viewmat, K, width, height)
    order = torch.argsort(depths[0])
    means2d, conics = means2d[0][order], conics[0][order]
    opacities, colors = leaves["opacities"][order], leaves["colors"][order]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = means2d[:, 0] - x.reshape(-1, 1), means2d[:, 1] - y.reshape(-1, 1)  # [pixels, N]
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where(alpha < 1 / 255, 0, alpha)
    before = torch.cumprod(torch.cat([torch.ones(len(alpha), 1), 1 - alpha[:, :-1]], dim=1), dim=1)
    return ((before * alpha) @ colors).reshape(height, width, 3)


if __name__ == "__main__":
    main(*sys.argv[1:])
