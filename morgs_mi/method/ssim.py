"""L_recon (eq. 2) and its derivative in two traced passes.

L_recon is (1 - lambda) L1 + lambda (1 - SSIM). SSIM (Wang et al. 2004) has the 11x11 Gaussian
window of sigma 1.5 and takes pixels outside the image as black. With x the image, y its target and
M the mean over a window,

    SSIM = (2 Mx My + C1) (2 (Mxy - Mx My) + C2) / ((Mx^2 + My^2 + C1) (Mxx - Mx^2 + Myy - My^2 +
    C2)).

Two traced passes, over a whole view or a region of it: the first computes SSIM's derivatives D by
Mx, Mxx and Mxy at every window, the second propagates them back through the window, which is its
own transpose:

    dL/dx = (1 - lambda) sign(x - y) - lambda (M D_x + 2 x M D_xx + y M D_xy).

My and Myy come from a pass of their own, once per target and region. In all three, a SIMD lane
walks down a run of rows of a strip (see `ssim_layout`). It blurs each row horizontally and adds it
to the 11 windows that contain the row: every number is read once, and no blurred row is written to
memory.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque, owned_copy
from morgs_mi.core.types import Arrays, Bool, Float, Int32, Jit, Tensor, UInt32, Vector2f
from morgs_mi.method.ssim_layout import (
    COLUMN,
    RADIUS,
    STRIP,
    Lanes,
    Planes,
    packet_type,
    read_packet,
    write_packet,
)
from morgs_mi.platform.checks import valid_pixels
from morgs_mi.render.backend import elements, on_aligned_stack
from morgs_mi.render.kernel_recording import recorded
from morgs_mi.render.region import DrawnBlocks, Region

_Row = Jit  # `packet_type` of the numbers of a row of pixels
_Read = Callable[[Float], _Row]  # plane -> its numbers around the lane's row

_C1 = 0.01**2
_C2 = 0.03**2
_TAPS = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 1.5) ** 2)
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32).tolist()


class Comparison:
    """A target on a region, or on the whole view, and all that an image there is compared by.

    Not a dataclass: `dr.custom` copies those.

    Attributes:
        planes: the layout of the images.
        pixels: planes of the target.
        region: the pixels that are compared; None: a whole view.
        runs: of ``windows``, of the pixels (``lanes``) and, on a region, ``around`` it.
        windows: runs of the centres of the windows that pixels of the region lie in.
        mean: planes of M y, defined on `windows`.
        variance: planes of M yy - (M y)^2, likewise.
        count: number of the windows, one for each colour.
        valid_share: inverse of the number of valid pixels, one for each colour.
        scale: inverse of the number of the view's pixels, one for each colour.
        height: of the view.
        surroundings: planes in which the image replaces the pixels of the region, the target
            elsewhere; None: it is a whole view's, or its planes are new each time.
        around: runs of all pixels around the region that the windows read, which new planes have
            of the target.
        weight: planes, 0 where the target is masked; None: it is valid everywhere.
        mse: mean squared error of the image that was compared last, over the valid pixels.
    """

    region: DrawnBlocks | None = None
    runs: Mapping[str, Arrays]
    windows: Lanes
    mean: Float
    variance: Float
    count: float | Float
    valid_share: float | Float
    scale: float | Float
    height: int | Int32
    surroundings: Float | None = None
    around: Lanes | None = None
    weight: Float | None = None
    mse: Float

    def __init__(self, planes: Planes, pixels: Float, **numbers: Any) -> None:
        self.planes = planes
        self.pixels = pixels
        vars(self).update(numbers)

    @cached_property
    def lanes(self) -> Lanes:
        """Runs of the pixels; the argument's, if there is one."""
        return Lanes.of(self.runs["lanes"])

    @cached_property
    def _places(self) -> tuple[UInt32, Bool]:
        """Places of the numbers of an image on the region, and the mask of those in the view."""
        assert self.region is not None
        return self.planes.places_on(self.region)

    @property
    def on_region(self) -> tuple[Float, Float | None]:
        """The target on the region, flat, 0 outside the view, and the weights of its numbers; None:
        1.
        """
        return _on(self, self.region)

    def comparison(self, region: object) -> Comparison:
        """Return itself: it has its region."""
        del region
        return self

    def of(self, x: Float) -> Float:
        """Return the planes of a flat image on the region, with the target around it."""
        if self.region is None:
            # In memory allocated by Dr.Jit.
            image = self.planes.of(x * opaque(mi.Float, 1))
            return image if self.weight is None else image * self.weight
        image = self.surroundings
        if image is None:
            assert self.around is not None
            image = self.planes.copied(self.pixels, self.around)
        places, valid = self._places
        mode = dr.ReduceMode.NoConflicts
        dr.scatter(image, self._masked(x), places, active=valid, mode=mode)
        return image

    def image(self, planes: Float) -> Float:
        """Return the flat image on the region of planes, 0 where the target is masked."""
        if self.region is None:
            return self.planes.image(planes if self.weight is None else planes * self.weight)
        places, valid = self._places
        return self._masked(dr.gather(mi.Float, planes, places, active=valid))

    def _masked(self, x: Float) -> Float:
        """Return a flat image on the region, set to 0 where the target is masked."""
        return x if self.weight is None else x * elements(self.weight, self._places[0])


class Target:
    """A target image. Its terms of SSIM are computed once for each region on which it is compared.

    Args:
        image: [H, W, 3], RGB, encoded: uint8, or floats, of which 1 is white and HDR images have
            larger ones.
        mask: [H, W] bool; pixels that are False do not count. None: all pixels count.
    """

    #: Mean squared error of the image that was compared last, over the valid pixels of its region.
    mse: Float

    def __init__(self, image: np.ndarray, mask: np.ndarray | None = None) -> None:
        self.shape: tuple[int, ...] = image.shape
        self._mask = mask
        self.planes = Planes(*image.shape[:2])
        self.weight: Float | None = None
        self.pixels = self._planes(image)
        if mask is not None and not mask.all():
            self.weight = self._planes(np.repeat(mask[..., None], 3, axis=2).astype(np.float32))
            self.pixels = self.masked(self.pixels)
            dr.eval(self.pixels)
        self._surroundings: Float | None = None
        self._comparisons: dict[Region | None, Comparison] = {}

    def _planes(self, image: np.ndarray) -> Float:
        if image.dtype == np.uint8:  # a quarter of the memory to copy
            pixels = mi.Float(from_numpy(sys.modules[mi.Float.__module__].UInt8, image)) / opaque(
                mi.Float, 255
            )
            dr.eval(pixels)
        else:
            pixels = from_numpy(mi.Float, image)
        planes = self.planes.of(pixels)
        dr.eval(planes)
        return planes

    def image(self) -> np.ndarray:
        """Return the target [H, W, 3], float32 with white at 1; black where masked."""
        return np.asarray(self.planes.image(self.pixels)).reshape(self.shape)

    def difference(self, image: Tensor) -> np.ndarray:
        """Return the target minus an image, [H, W, 3]; 0 where masked."""
        error = self.pixels - self.masked(self.planes.of(owned_copy(dr.detach(image).array)))
        return np.asarray(self.planes.image(error)).reshape(self.shape)

    def on(self, region: Region | None) -> tuple[Float, Float | None]:
        """Return the target on a region, flat, 0 outside the view, and the weights of its numbers;
        None: 1.
        """
        return _on(self, region)

    def gradient(self, region: Region) -> Vector2f:
        """Return the derivatives of the target along x and y on a region, flat, per px."""
        return self.planes.gradient_on(self.pixels, region)

    def constant_error(self, region: Region | None = None) -> float:
        """Return the mean squared error of the best image of one grey, over the valid pixels of a
        region; 0 without any.
        """
        numbers = self.on(region)[0]  # 0 where they are not valid
        count = self._num_valid(region)
        mean = np.asarray(dr.sum(numbers)).item() / count
        return np.asarray(dr.sum(dr.square(numbers))).item() / count - mean**2

    def _num_valid(self, region: Region | None) -> int:
        """Return the number of valid numbers on a region, at least 1."""
        valid = valid_pixels(self._mask, self.shape) & (region is None or region.mask)
        return max(3 * int(valid.sum()), 1)

    def comparison(self, region: Region | None) -> Comparison:
        """Return the target on a region, or on the whole view for None."""
        if region not in self._comparisons:
            windows_runs, count = self.planes.runs(region, RADIUS)
            runs = {"windows": windows_runs, "lanes": self.planes.runs(region, 0)[0]}
            windows = Lanes.of(windows_runs)
            (mean, variance), _ = recorded(_statistics_pass, self.planes.size)(
                windows, opaque(mi.Int32, self.planes.height), self.pixels
            )
            on = self._comparisons[region] = Comparison(
                self.planes,
                self.pixels,
                region=region,
                runs=runs,
                weight=self.weight,
                windows=windows,
                mean=mean,
                variance=variance,
                count=count,
                valid_share=1 / self._num_valid(region),
                scale=1 / int(np.prod(self.shape)),
                height=self.planes.height,
            )
            if region is not None:
                runs["around"] = self.planes.runs_around(region, RADIUS)
                if self._surroundings is None:
                    self._surroundings = self.pixels + 0
                on.surroundings = self._surroundings
        return self._comparisons[region]

    def masked(self, values: Float) -> Float:
        """Return planes, set to 0 where the mask is False."""
        return values if self.weight is None else values * self.weight


def _on(target: Target | Comparison, region: DrawnBlocks | None) -> tuple[Float, Float | None]:
    """Return a target on a region, see `Target.on`."""
    planes = target.planes
    weight = None if target.weight is None else planes.on(target.weight, region)
    return planes.on(target.pixels, region), weight


class Recon(dr.CustomOp):
    """L_recon, with the derivative that `eval` computes along with it."""

    gradient: Float

    def eval(self, x: Float, on: Comparison, weight: float) -> Float:
        size = on.planes.size
        image = on.of(x)
        dr.eval(image)
        height = opaque(mi.Int32, on.height)
        scale = opaque(mi.Float, on.scale)
        arguments = (on.windows, height, image, on.pixels, on.mean, on.variance)
        derivatives, ssim = recorded(_similarity_pass, size)(*arguments)
        arguments = (on.lanes, height, image, on.pixels, derivatives, scale)
        (gradient,), errors = recorded(_gradient_pass, size, weight)(*arguments)
        dr.schedule(ssim, errors)
        self.gradient = on.image(gradient)
        dr.eval(self.gradient)
        # Not evaluated here: nothing but a report has the numbers.
        structure = opaque(mi.Float, on.count) - dr.sum(ssim)
        on.mse = dr.sum(errors.y) * opaque(mi.Float, on.valid_share)
        return scale * ((1 - weight) * dr.sum(errors.x) + weight * structure)

    def backward(self) -> None:
        self.set_grad_in("x", self.gradient * self.grad_out())

    def forward(self) -> None:
        self.set_grad_out(dr.dot(self.gradient, self.grad_in("x")))


def _statistics_pass(
    size: int, lanes: Lanes, height: Int32, target: Float
) -> tuple[list[Float], Float]:
    """Return the planes of M y and M yy - (M y)^2, and the sum of M y over each run."""

    def moments(read: _Read) -> list[_Row]:
        y = read(target)
        return [y, y * y]

    def statistics(read: _Read, means: list[_Row], counts: Bool) -> tuple[list[_Row], Jit]:
        mean, square = means
        return [mean, dr.fma(-mean, mean, square)], dr.select(counts, mean, 0)

    return _walk(size, lanes, height, moments, statistics, 2, 2, mi.Float(0))


def _similarity_pass(
    size: int,
    lanes: Lanes,
    height: Int32,
    image: Float,
    target: Float,
    mean: Float,
    variance: Float,
) -> tuple[list[Float], Float]:
    """Return the planes of SSIM's derivatives by M x, M xx and M xy, and the sum of SSIM over each
    run.
    """

    def products(read: _Read) -> list[_Row]:
        x = read(image)
        y = read(target)
        return [x, x * x, x * y]

    def similarity(read: _Read, means: list[_Row], counts: Bool) -> tuple[list[_Row], Jit]:
        mx, xx, xy = means
        ssim, *derivatives = _similarity(mx, xx, xy, read(mean), read(variance))
        return derivatives, dr.select(counts, ssim, 0)

    return _walk(size, lanes, height, products, similarity, 3, 3, mi.Float(0))


def _similarity(
    mx: _Row, xx: _Row, xy: _Row, my: _Row, variance: _Row
) -> tuple[_Row, _Row, _Row, _Row]:
    """Return SSIM of the windows of a row and its derivatives by M x, M xx and M xy."""
    a1 = dr.fma(2 * mx, my, _C1)
    a2 = dr.fma(2.0, dr.fma(-mx, my, xy), _C2)
    b1 = dr.fma(mx, mx, dr.fma(my, my, _C1))
    b2 = dr.fma(-mx, mx, xx) + (variance + _C2)
    r1 = dr.rcp(b1)
    r2 = dr.rcp(b2)
    r12 = r1 * r2
    ssim = a1 * a2 * r12
    d_x = 2 * dr.fma(my * r12, a2 - a1, mx * ssim * (r2 - r1))
    return ssim, d_x, -ssim * r2, 2 * a1 * r12


def _gradient_pass(
    size: int,
    weight: float,
    lanes: Lanes,
    height: Int32,
    image: Float,
    target: Float,
    derivatives: list[Float],
    scale: Float,
) -> tuple[list[Float], Jit]:
    """Return the planes of dL/dx, and the sums of |x - y| and (x - y)^2 over each run."""

    def unchanged(read: _Read) -> list[_Row]:
        return [read(plane) for plane in derivatives]

    def gradient(read: _Read, means: list[_Row], counts: Bool) -> tuple[list[_Row], Jit]:
        d_x, d_xx, d_xy = means
        x = read(image)
        y = read(target)
        error = x - y
        structure = dr.fma(y, d_xy, dr.fma(2 * x, d_xx, d_x))
        sign = dr.select(error > 0, 1.0, dr.select(error < 0, -1.0, 0.0))
        row = scale * ((1 - weight) * sign - weight * structure)
        error = dr.select(counts, error, 0)
        return [row], [mi.Vector2f(dr.abs(e), dr.square(e)) for e in error]

    return _walk(size, lanes, height, unchanged, gradient, 3, 1, mi.Vector2f(0))


def _walk(
    size: int,
    lanes: Lanes,
    height: Int32,
    across: Callable[[_Read], list[_Row]],
    finish: Callable[[_Read, list[_Row], Bool], tuple[list[_Row], Jit]],
    inputs: int,
    outputs: int,
    total: Jit,
) -> tuple[list[Float], Jit]:
    """Walk down the runs with a window: blur the rows that `across` returns, and write those that
    `finish` returns.

    Args:
        size: size of the planes.
        lanes: the runs.
        height: height of the image.
        across: read -> rows of numbers, wider than a strip by 5 on both sides.
        finish: (read, these rows blurred, of a strip, mask of its pixels that count) -> (rows of a
            strip to write, numbers of a strip to sum, 0 for other pixels).
        inputs: number of rows to blur.
        outputs: number of rows to write.
        total: 0, of the type of the numbers to sum.

    Returns:
        The planes that were written, defined on the runs, and the sum over the pixels of each run.
    """
    packet = packet_type()
    targets = [dr.empty(mi.Float, size) for _ in range(outputs)]

    def blurred(row: Int32) -> Jit:
        valid = (row >= 0) & (row < height)
        down = mi.UInt32(row) * COLUMN

        def wide(plane: Float) -> _Row:
            numbers = [v for place in lanes.places for v in read_packet(plane, place + down, valid)]
            return packet(numbers[STRIP - RADIUS : 2 * STRIP + RADIUS])

        sums = []
        for row_of_plane in across(wide):
            values = list(row_of_plane)
            total = packet(values[:STRIP]) * _TAPS[0]
            for k, tap in enumerate(_TAPS[1:], 1):
                total = dr.fma(packet(values[k : k + STRIP]), tap, total)
            sums += list(total)
        return packet(sums)

    def body(row, windows, total, targets):
        # Two rows per turn: the windows are read and written half as often. Window k ends k rows
        # further down.
        a = blurred(row)
        b = blurred(row + 1)
        w = _TAPS
        done = dr.fma(a, w[0], windows[0]), dr.fma(b, w[0], dr.fma(a, w[1], windows[1]))
        windows = [dr.fma(a, w[k], dr.fma(b, w[k - 1], windows[k])) for k in range(2, 2 * RADIUS)]
        windows += [dr.fma(a, w[-1], b * w[-2]), b * w[-1]]

        valid = dr.mask_t(packet)([lanes.columns > k for k in range(STRIP)])
        for k in range(2):
            at = row + k - RADIUS
            center = lanes.places[1] + mi.UInt32(at) * COLUMN
            ready = (at >= lanes.first) & (at < end)

            def narrow(plane: Float, center: UInt32 = center, ready: Bool = ready) -> _Row:
                return read_packet(plane, center, ready)

            sums = list(done[k])
            means = [packet(sums[STRIP * c : STRIP * (c + 1)]) for c in range(inputs)]
            planes, numbers = finish(narrow, means, valid & ready)
            for target, values in zip(targets, planes, strict=True):
                write_packet(target, dr.select(valid, values, 0), center, ready)
            for number in numbers:
                total = total + number
        return row + 2, windows, total, targets

    windows = [packet([mi.Float(0) for _ in range(inputs * STRIP)]) for _ in range(2 * RADIUS)]
    end = on_aligned_stack(lanes.end)
    state = (lanes.first - RADIUS, windows, total, targets)
    *_, total, targets = dr.while_loop(
        state, lambda row, *_: row < end + RADIUS, body, label="window"
    )
    return targets, total
