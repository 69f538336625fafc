"""The losses: L_recon (eq. 2), L_flow (eq. 7), L_mask (eq. 11) and L_off, each a scalar Dr.Jit tensor.

Every loss is a mean, over pixels or Gaussians, so that its weight does not depend on the picture's size.
SSIM (Wang et al. 2004) has the 11x11 Gaussian window of sigma 1.5 and takes what is outside as black.
"""

from __future__ import annotations

from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["Target", "flow_loss", "mask_loss", "offset_loss", "recon_loss"]

_C1, _C2 = 0.01**2, 0.03**2
_WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)


class Target:
    """A picture to be matched, with what SSIM needs of it computed once.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1], display-referred.
        mask: [H, W] bool; what is False does not count. None: everything counts.
    """

    def __init__(self, image: np.ndarray, mask: np.ndarray | None = None) -> None:
        pixels = image.astype(np.float32) / 255 if image.dtype == np.uint8 else image.astype(np.float32)
        weight = None
        if mask is not None and not mask.all():
            weight = np.repeat(mask[..., None], 3, axis=2).astype(np.float32)
            pixels = pixels * weight
        self.shape: tuple[int, ...] = pixels.shape
        self.pixels = mi.Float(pixels.ravel())
        self.weight = None if weight is None else mi.TensorXf(weight)
        self.blurred = mi.Float(_blur(np.concatenate([pixels, pixels * pixels], axis=2)).ravel())
        dr.eval(self.pixels, self.blurred)


def recon_loss(image: Any, target: Target, dssim_weight: float = 0.2) -> Any:
    """Return (1 - lambda) mean |I - I*| + lambda (1 - SSIM) (eq. 2), differentiable in `image` [H, W, 3].

    Value and derivative are computed together, so that backward costs one multiplication.

    Raises:
        ValueError: image and target differ in size.
    """
    if tuple(image.shape) != tuple(target.shape):
        raise ValueError(f"recon_loss(): `image` must be {target.shape} like its target, got {tuple(image.shape)}.")
    if target.weight is not None:
        image = image * target.weight
    return dr.custom(_Recon, image.array, target, dssim_weight)


class _Recon(dr.CustomOp):
    def eval(self, x: Any, target: Target, weight: float) -> Any:
        y, (H, W, _) = target.pixels, target.shape
        n = H * W * 3
        lane = dr.arange(mi.UInt32, n)
        texel = lane // 3 * 6 + lane % 3  # into the target's blurred y and y^2, interleaved [H, W, 6]
        mu_y, yy = dr.gather(mi.Float, target.blurred, texel), dr.gather(mi.Float, target.blurred, texel + 3)
        mu_x, xx, xy = _blur3(x, x * x, x * y, H, W)

        a1, a2 = 2 * mu_x * mu_y + _C1, 2 * (xy - mu_x * mu_y) + _C2
        b1, b2 = mu_x * mu_x + mu_y * mu_y + _C1, xx - mu_x * mu_x + yy - mu_y * mu_y + _C2
        inverse = dr.rcp(b1 * b2)
        ssim = a1 * a2 * inverse
        # dSSIM/d(mu_x, xx, xy), then through the window, which is its own transpose
        d_xy, d_xx = 2 * a1 * inverse, -ssim * dr.rcp(b2)
        d_mu = 2 * (mu_y * (a2 - a1) * inverse - mu_x * ssim * (dr.rcp(b1) - dr.rcp(b2)))
        d_mu, d_xx, d_xy = _blur3(d_mu, d_xx, d_xy, H, W)

        error = x - y
        scale = 1 / n
        self.grad = (1 - weight) * scale * dr.sign(error) * dr.select(error == 0, 0, 1)
        self.grad -= weight * scale * (d_mu + 2 * x * d_xx + y * d_xy)
        loss = (1 - weight) * dr.mean(dr.abs(error)) + weight * (1 - dr.mean(ssim))
        dr.eval(self.grad, loss)
        return loss

    def backward(self) -> None:
        self.set_grad_in("x", self.grad * self.grad_out())

    def forward(self) -> None:
        self.set_grad_out(dr.dot(self.grad, self.grad_in("x")))

    def name(self) -> str:
        return "morgs_mi.recon_loss"


def _blur3(a: Any, b: Any, c: Any, H: int, W: int) -> tuple[Any, Any, Any]:
    """Blur three pictures [H * W * 3] in one pass of OpenCV's separable filter, six times as fast as `dr.convolve`."""
    n = H * W * 3
    stacked = dr.empty(mi.Float, 3 * n)
    texel = dr.arange(mi.UInt32, n)
    texel = texel // 3 * 9 + texel % 3
    for k, picture in enumerate((a, b, c)):
        dr.scatter(stacked, picture, texel + 3 * k, mode=dr.ReduceMode.NoConflicts)
    blurred = mi.Float(_blur(np.asarray(stacked).reshape(H, W, 9)).ravel())
    a, b, c = (dr.gather(mi.Float, blurred, texel + 3 * k) for k in range(3))
    return a, b, c


def _blur(image: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, -1, _WINDOW, _WINDOW, borderType=cv2.BORDER_CONSTANT)


def flow_loss(motion: Any, cue: Any, reliable: Any) -> Any:
    """Return the mean endpoint error in px between the rendered motion map and the flow's motion (eq. 7).

    Args:
        motion: rendered [H, W, 2], px, x_t - x_{t-1}.
        cue: from optical flow on the same grid [H, W, 2], px, of the same sign.
        reliable: [H, W] of 0 and 1; the mean is over all pixels, so that little evidence weighs little.
    """
    n = int(motion.shape[0]) * int(motion.shape[1])
    lane = dr.arange(mi.UInt32, n) * 2
    x, y = (
        dr.gather(mi.Float, motion.array, lane + k, mode=dr.ReduceMode.NoConflicts)
        - dr.gather(mi.Float, cue.array, lane + k)
        for k in range(2)
    )
    # A hundredth of a pixel keeps the derivative finite where both agree.
    return dr.mean(dr.sqrt(x * x + y * y + 1e-4) * reliable.array)


def mask_loss(confidence: Any, mask: Any) -> Any:
    """Return mean |M~ - M| of the rendered confidence [H, W, 1] and the motion mask [H, W] (eq. 11)."""
    return dr.mean(dr.abs(confidence.array - mask.array))


def offset_loss(offset: Any, extent: float) -> Any:
    """Return the mean L1 norm of the offsets [N, 3] over the scene's extent (L_off)."""
    return dr.sum(dr.abs(offset.array)) / (int(offset.shape[0]) * extent)
