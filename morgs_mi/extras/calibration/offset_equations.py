"""Equations of the time offsets of cameras, from Gaussians of one timestamp and images of slightly
different times.

Gaussian k moves by d_k in a frame, which view v shows as m = J_v d_k pixels, with J_v the
derivative of its projection. If the clock of the view is o_v frames ahead, the image shows the
Gaussian displaced by o_v m. Gaussians that are fitted to all views at once lie between the
positions in these views, at a distance x_k from their true positions. With the error e = image -
render and the gradient g of the image,

    e + g . (o_v m - J_v x_k) = 0

in each pixel and colour. A Gaussian's weight in a pixel weights its equations. The sums over the
pixels

    A_vk = sum w_k g g^T ,    b_vk = sum w_k e g

are backprojections of two images. Least squares in the offsets and the positions, with the
positions eliminated like points in bundle adjustment (Schur complement; Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, section 6.1), leaves one equation per view,

    sum_w S_vw o_w = r_v ,    c_vk = J_v^T A_vk J_v d_k ,    H_k = sum_w J_w^T A_wk J_w + lambda ,
    S_vw = sum_k (d_k^T c_vk [v = w] - c_vk^T H_k^-1 c_wk) ,
    r_v = sum_k (c_vk^T H_k^-1 sum_w J_w^T b_wk - d_k^T J_v^T b_vk) ,

where w runs over the training views. A held-out view also has an equation, but its offset is in no
other equation. Equal offsets of all views solve S o = 0: they move the Gaussians along their
motion. Offsets that other positions of the Gaussians explain nearly solve it, too, for example with
motion along the epipolar lines of two cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import KDTree

from morgs_mi.core.gaussians import ActivatedGaussians, Gaussians
from morgs_mi.core.view import View
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView, backproject
from morgs_mi.render.rasterize import render_view

# lambda, as a fraction of a Gaussian's mean curvature along an axis.
_PRIOR = 1e-4
# Added to the eigenvalues of S for a step and for its error, as fractions of its mean diagonal
# without elimination.
_DAMPING = 0.03
_FLOOR = 1e-3
# Standard deviation in frames of an unknown offset.
UNKNOWN = 1.0
# Mean number of Gaussians of a group, which counts as one error: neighbours share pixels and have
# similar errors.
_GROUP = 32


@dataclass(frozen=True, eq=False)
class OffsetEquations:
    """S o = r of V views; sums of the equations of several timestamps are equations again."""

    matrix: np.ndarray  #: S [V, V]; the columns of held-out views are zero off the diagonal.
    right: np.ndarray  #: r [V].
    #: Sum over groups of neighbouring Gaussians of the products of their parts of r [V, V].
    scatter: np.ndarray
    #: Sum of d^T c [V], the diagonal of S if the Gaussians were in their true positions.
    own: np.ndarray
    train: np.ndarray  #: Mask of the training views, bool [V].

    def __add__(self, other: OffsetEquations) -> OffsetEquations:
        return OffsetEquations(
            self.matrix + other.matrix,
            self.right + other.right,
            self.scatter + other.scatter,
            self.own + other.own,
            self.train,
        )

    def solution(self, share: float = 1.0) -> np.ndarray:
        """Return o [V] in frames, with a mean of zero over the training views.

        Args:
            share: part of the training views' offsets that their equations show.
        """
        return self._inverse(_DAMPING, share) @ self.right

    def errors(self, reference: int) -> np.ndarray:
        """Return the standard error [V] in frames of each offset relative to the view `reference`.

        The parts of r of groups of neighbouring Gaussians count as independent: a sandwich estimate
        with clusters (Liang and Zeger, Biometrika 73(1), 1986). Offsets that the equations do not
        determine have an error of a frame.
        """
        inverse = self._inverse(_FLOOR)
        blindness = np.eye(len(inverse)) - inverse @ self.matrix
        noise = inverse - inverse[reference]
        lost_part = blindness - blindness[reference]
        return np.sqrt(
            np.einsum("vi,ij,vj->v", noise, self.scatter, noise)
            + UNKNOWN**2 * (lost_part**2).sum(axis=1)
        )

    def _inverse(self, damping: float, share: float = 1.0) -> np.ndarray:
        """Return the matrix [V, V] that turns r into o."""
        train = self.train
        block = np.ix_(train, train)
        scale = self.own.mean() or 1.0
        diagonal = np.diag(self.matrix) + _FLOOR * scale
        whole = np.zeros_like(self.matrix)
        whole[block] = _centred_inverse(self.matrix[block], damping * scale) / share
        for view in np.flatnonzero(~train):
            unit = np.eye(len(train))[view]
            whole[view] = (unit - self.matrix[view, train] @ whole[train]) / diagonal[view]
        return whole


def _centred_inverse(matrix: np.ndarray, damping: float) -> np.ndarray:
    """Return the inverse of a damped matrix [n, n] among vectors with a mean of zero."""
    centred = np.eye(len(matrix)) - 1 / len(matrix)
    values, vectors = np.linalg.eigh(centred @ matrix @ centred)
    inverse = (vectors / (np.maximum(values, 0) + damping)) @ vectors.T
    return centred @ inverse @ centred


def offset_equations(
    gaussians: Gaussians,
    views: Sequence[View],
    train: np.ndarray,
    blur: float,
) -> OffsetEquations:
    """Return the equations of a timestamp.

    Args:
        gaussians: N Gaussians fitted to the timestamp, with their `motion` in one frame.
        views: V views with their images at about that timestamp.
        train: mask of the views that the Gaussians are fitted to, bool [V].
        blur: standard deviation in pixels of a Gaussian filter of errors and gradients. Offsets
            with displacements up to about this value can be found; 0: no filter.
    """
    moving = (np.asarray(gaussians.motion) != 0).any(axis=1)
    d = np.asarray(gaussians.motion, np.float64)[moving]
    means = np.asarray(gaussians.means, np.float64)[moving]
    H = np.empty((len(views), *means.shape, 3))
    b = np.empty((len(views), *means.shape))
    for v, view in enumerate(views):
        drawn = ActiveView(view.camera)
        target = Target(view.image, view.mask)
        error = blurred(target.difference(render_view(gaussians, drawn).color), blur)
        gradient = image_gradient(blurred(target.image(), blur))
        products, error_products = gradient_products(gaussians, drawn, error, gradient)
        J = view.camera.projection_jacobian(means)
        H[v] = np.einsum("kai,kab,kbj->kij", J, products[moving], J)
        b[v] = np.einsum("kai,ka->ki", J, error_products[moving])
    c = np.einsum("vkij,kj->vki", H, d)
    curvatures = H[train].sum(axis=0)
    prior = _PRIOR * np.trace(curvatures, axis1=1, axis2=2) / 3 + np.finfo(float).tiny
    inverses = np.linalg.inv(curvatures + prior[:, None, None] * np.eye(3))
    weights = np.einsum("vki,kij->vkj", c, inverses)
    parts = np.einsum("vki,ki->vk", weights, b[train].sum(axis=0)) - np.einsum("vki,ki->vk", b, d)
    # Gaussians with the same nearest centre form a group.
    _, labels = KDTree(means[::_GROUP]).query(means)
    groups = np.stack([np.bincount(labels, row) for row in parts])
    diagonal = np.einsum("vki,ki->v", c, d)
    matrix = np.diag(diagonal)
    matrix[:, train] -= np.einsum("vki,wki->vw", weights, c[train])
    return OffsetEquations(matrix, parts.sum(axis=1), groups @ groups.T, diagonal, train)


def blurred(image: np.ndarray, blur: float) -> np.ndarray:
    """Return an image [H, W, C] after a Gaussian filter of standard deviation `blur` in pixels; 0:
    as it is.
    """
    return cv2.GaussianBlur(image, (0, 0), blur) if blur else image


def image_gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of a float32 image [H, W, C] by x and y, per px (Sobel's filter)."""
    x, y = (
        np.asarray(cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8))
        for order in ((1, 0), (0, 1))
    )
    return x, y


def gradient_products(
    gaussians: ActivatedGaussians,
    view: ActiveView,
    error: np.ndarray,
    gradient: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of g g^T [N, 2, 2] and of e g [N, 2] over the pixels and colours of a
    view, per Gaussian.

    Args:
        gaussians: N Gaussians; their blend weights weight the pixels.
        view: the whole view.
        error: e [H, W, 3].
        gradient: g, the derivatives [H, W, 3] along x and y, per px.
    """
    x, y = gradient
    sums = [np.sum(a * b, axis=-1) for a, b in ((x, x), (x, y), (y, y), (error, x), (error, y))]
    sums = backproject(gaussians, view, np.stack(sums, axis=-1)).astype(np.float64)
    return sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2), sums[:, 3:]
