"""The pinhole camera.

Notation: x_cam = R x_world + t with `viewmat = [R t; 0 1]` (OpenCV: x right, y down, z forward),
and a pixel is (fx x/z + cx, fy y/z + cy). Pixel centres lie at +0.5, so the image spans [0, width]
x [0, height].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.color_space import BRIGHTEST, unit_values
from morgs_mi.core.types import SceneDict, Tensor
from morgs_mi.platform.checks import (
    LARGEST,
    bounded,
    check_number,
    check_size,
    errors_at,
    numbers,
    require,
)
from morgs_mi.platform.png import PngImage

if TYPE_CHECKING:
    import mitsuba as mi  # imported where a sensor is read

# Mitsuba's camera looks along +z with x to the left and y up; OpenCV's has x right and y down.
_OPENCV_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])
OF_SENSOR = "convert a Mitsuba sensor by Camera.from_sensor()"
"""Remedy where another value than a camera is passed."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV's convention.

    Attributes:
        K: intrinsics [3, 3] in pixels, copied; the principal point may be off-centre.
        viewmat: extrinsics [4, 4], world -> camera: a NumPy array, which is copied, or a Dr.Jit
            tensor for gradients of the pose.
        width: image width in pixels.
        height: image height in pixels.
        name: in the capture, e.g. ``cam00``.
        near: depth in world units below which Gaussians are not rendered. The cameras of a capture
            have a depth that follows the scene (see `with_near_planes`).
        delay: frames by which its images are later than the timestamps of the recording, at the
            middle row. Gaussians with motion are rendered where they are then.
        readout: frames between the exposures of the first and the last row; 0 for a global shutter.
        background: image [H, W, 3] behind all Gaussians in this view, in the colours of its images:
            uint8, or floats with 1 for white, which is copied; or a `PngImage` of that size, as in
            the cameras of a stream. None: the colour of the renderer's settings.

    Example:
        >>> size = {"width": 320, "height": 240}
        >>> camera = morgs_mi.Camera.look_at((0, -4, 1), (0, 0, 0), (0, 0, 1), fov_x=40, **size)
        >>> pixels, depths = camera.project(points)

    Raises:
        ValueError: a size below 1x1, matrices of another shape or with numbers that are not finite
            or above 1e12, a focal length or `near` that is not positive, or a `viewmat` that is no
            rotation and translation. Only the shape of a Dr.Jit `viewmat` is checked here;
            `rasterize` checks that it is finite.
    """

    K: np.ndarray
    viewmat: np.ndarray | Tensor
    width: int
    height: int
    name: str = ""
    near: float = 0.01
    delay: float = 0.0
    readout: float = 0.0
    background: np.ndarray | PngImage | None = None

    def __post_init__(self) -> None:
        where = f"Camera({self.name!r})" if self.name else "Camera()"
        check_size(where, self.width, self.height)
        check_number(where, "near", self.near, "[1e-30, inf)")  # its reciprocal is a finite float32
        check_number(where, "delay", self.delay, "[-1, 1]")
        check_number(where, "readout", self.readout, "[-1, 1]")
        K = numbers(where, "K", self.K, 3, 3).astype(np.float64)
        require(
            bounded(K) and min(K[0, 0], K[1, 1]) * LARGEST >= 1,  # so are their reciprocals
            where,
            "`K` must be finite with positive focal lengths",
            K.tolist(),
            "check the calibration",
        )
        require(
            np.array_equal(K, intrinsic_matrix(K[0, 0], K[1, 1], K[0, 2], K[1, 2])),
            where,
            "`K` must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            K.tolist(),
            "resample the images to a camera without skew",
        )
        viewmat = self.viewmat
        if isinstance(viewmat, dr.ArrayBase):
            shape = tuple(viewmat.shape)
            require(shape == (4, 4), where, "`viewmat` must be [4, 4]", shape, "pass one camera's")
        else:
            viewmat = rigid(f"{where}, `viewmat`", numbers(where, "viewmat", viewmat, 4, 4))
        if isinstance(self.background, PngImage):
            require(
                self.background.size == self.size,
                where,
                f"`background` must be a PNG file of {self.width}x{self.height} pixels",
                "one of {}x{}".format(*self.background.size),
                "use the camera of that size",
            )
        elif self.background is not None:
            image = numbers(where, "background", self.background, self.height, self.width, 3)
            values = unit_values(image, np.float32)
            require(
                (np.abs(values) <= BRIGHTEST).all(),
                where,
                f"`background` must have numbers from {-BRIGHTEST:g} to {BRIGHTEST:g}, 1 for white",
                "others",
                "paint the pixels without one",
            )
            object.__setattr__(self, "background", values)
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "viewmat", viewmat)

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.4g}" for x in self.position + 0.0)  # without -0
        return (
            f"Camera({self.name!r}, {self.width}x{self.height}, {self._fov_x:.3g} degrees across, "
            f"at ({place}))"
        )

    @classmethod
    def look_at(
        cls,
        origin: ArrayLike,
        target: ArrayLike,
        up: ArrayLike,
        fov_x: float,
        width: int,
        height: int,
        name: str = "",
    ) -> Camera:
        """Return the camera at `origin` [3] that looks at `target` [3]; `fov_x` in degrees across,
        below 180.

        The near plane is at 0.01, or at a hundredth of the distance to `target` if that is less.

        Raises:
            ValueError: `target` is at `origin` or above or below it in the direction of `up`, and
                as for `Camera`.
        """
        where = "Camera.look_at()"
        check_size(where, width, height)
        check_number(where, "fov_x", fov_x, "(0, 180)")
        named_vectors = {"origin": origin, "target": target, "up": up}
        origin, target, up = (
            numbers(where, key, value, 3).astype(np.float64) for key, value in named_vectors.items()
        )
        forward = target - origin
        right = np.cross(forward, up)
        distance = np.linalg.norm(forward)
        require(
            np.linalg.norm(right) > 1e-12 * (distance * np.linalg.norm(up)),
            where,
            "`up` must not be parallel to the direction of view",
            f"origin {origin.tolist()}, target {target.tolist()}, up {up.tolist()}",
            "tilt it",
        )
        forward = forward / distance
        right = unit_vectors(right)
        viewmat = pose_at(np.stack([right, np.cross(forward, right), forward]), origin)
        K = intrinsics_of_fov(fov_x, width, height)
        return cls(K, viewmat, width, height, name, near=min(0.01, float(distance) / 100))

    @classmethod
    def of(cls, view: Any) -> Camera:
        """Return a camera as it is, or the one of a Mitsuba sensor (see `from_sensor`)."""
        return view if isinstance(view, Camera) else cls.from_sensor(view)

    @classmethod
    def from_sensor(cls, sensor: mi.Sensor) -> Camera:
        """Return the view of a Mitsuba `perspective` sensor, without gradients: the inverse of
        `sensor`.

        It has the size of the whole film, and the sensor's id as its name.

        Raises:
            ValueError: it is a sensor of another kind, or scales the world.
        """
        import mitsuba as mi

        is_sensor = isinstance(sensor, mi.Sensor)
        kind = sensor.class_name() if is_sensor else f"a {type(sensor).__name__}"
        require(
            kind == "PerspectiveCamera",
            "Camera.from_sensor()",
            "`sensor` must be a `perspective` sensor",
            kind,
            "splats are drawn only by pinhole cameras without lens distortion",
        )
        params: Any = mi.traverse(sensor)
        width, height = map(int, sensor.film().size())
        names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y", "near_clip")
        fov, *offset, near = (float(np.asarray(params[name]).item()) for name in names)
        K = intrinsics_of_fov(fov, width, height, *offset)
        to_world = np.asarray(params["to_world"].matrix, float).reshape(4, 4)
        viewmat = _OPENCV_FROM_MITSUBA @ np.linalg.inv(to_world)
        return cls(K, viewmat, width, height, sensor.id(), near)

    @property
    def _fov_x(self) -> float:
        """Field of view in degrees across."""
        return np.rad2deg(2 * np.arctan(0.5 * self.width / self.K[0, 0]))

    @property
    def backdrop(self) -> np.ndarray | None:
        """The image behind all Gaussians, float32 [H, W, 3] with 1 for white.

        Raises:
            ValueError: it is a PNG file, which is broken.
        """
        image = self.background
        if not isinstance(image, PngImage):
            return image
        with errors_at(f"Camera({self.name!r}), `background`"):
            return unit_values(image.pixels, np.float32)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.width, self.height

    @property
    def world_to_camera(self) -> np.ndarray:
        """The extrinsics [4, 4] in NumPy, float64, without gradients."""
        return np.asarray(self.viewmat, np.float64)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation [3, 3] of the extrinsics; its rows are the camera's right, down and forward."""
        return self.world_to_camera[:3, :3]

    @property
    def position(self) -> np.ndarray:
        """The camera's centre [3] in world units."""
        return -self.rotation.T @ self.world_to_camera[:3, 3]

    @property
    def to_world(self) -> np.ndarray:
        """Mitsuba's `to_world` matrix [4, 4]: camera -> world with x to the left and y up."""
        return np.linalg.inv(self.world_to_camera) @ _OPENCV_FROM_MITSUBA

    def _local(self, points: np.ndarray) -> np.ndarray:
        """Return world points [..., 3] in the camera's coordinates."""
        return points @ self.rotation.T + self.world_to_camera[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixel positions [..., 2] and the depths z [...] of world points [..., 3].

        A point with z <= 0 is behind the camera and its pixel position is meaningless.
        """
        local = self._local(points)
        return (local @ self.K.T)[..., :2] / local[..., 2:], local[..., 2]

    def unproject(self, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Return the world points [..., 3] at pixel positions [..., 2] and depths z [...]: the
        inverse of `project`.
        """
        K = self.K
        x = (pixels[..., 0] - K[0, 2]) / K[0, 0]
        y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
        local = np.stack([x, y, np.ones_like(x)], axis=-1) * np.asarray(depths)[..., None]
        return (local - self.world_to_camera[:3, 3]) @ self.rotation

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin [3] and the unit directions [..., 3] of the rays through pixel
        positions [..., 2].
        """
        directions = self.unproject(pixels, np.ones(np.shape(pixels)[:-1])) - self.position
        return self.position, unit_vectors(directions)

    def projection_jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d(pixel) / d(point) [N, 2, 3] at world points [N, 3]; zero for points behind the
        near plane.
        """
        x, y, z = self._local(points).T
        inverse = np.where(z > self.near, 1 / np.maximum(z, self.near), 0)
        fx = self.K[0, 0] * inverse
        fy = self.K[1, 1] * inverse
        zero = np.zeros_like(z)
        rows = [fx, zero, -fx * x * inverse, zero, fy, -fy * y * inverse]
        return np.stack(rows, axis=1).reshape(-1, 2, 3) @ self.rotation

    def without_delays(self) -> Camera:
        """Return the same view with images of the timestamps themselves: no delay and no rolling
        shutter.
        """
        return replace(self, delay=0.0, readout=0.0)

    def relative_to(self, origin: np.ndarray) -> Camera:
        """Return the camera relative to a point `origin` [3] of the world."""
        shift = np.eye(4)
        shift[:3, 3] = origin
        return replace(self, viewmat=self.world_to_camera @ shift)

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view on a grid of width x height pixels (intrinsics scaled to match)."""
        if (width, height) == self.size:
            return self
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        image = self.backdrop
        if image is not None:
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return replace(self, K=K, width=width, height=height, background=image)

    def with_width(self, width: int) -> Camera:
        """Return the same view with images of another width and the same aspect ratio.

        Raises:
            ValueError: `width` is below 1.
        """
        check_number("Camera.with_width()", "width", width, "[1, inf)")
        return self.resized(width, max(1, round(width * self.height / self.width)))

    def square(self) -> Camera:
        """Return the same view with equal focal lengths, to half a pixel of its height, which may
        be another one.
        """
        return self.resized(self.width, max(1, round(self.height * self.K[0, 0] / self.K[1, 1])))

    def sensor(self, **film: Any) -> SceneDict:
        """Return a Mitsuba `perspective` sensor dictionary of this view.

        Keyword arguments override entries of the film (e.g. ``rfilter``, ``pixel_format``).

        Raises:
            ValueError: fx and fy differ by more than a pixel in the height of the image: Mitsuba's
                sensor has one focal length.
        """
        import mitsuba as mi

        fx = self.K[0, 0]
        fy = self.K[1, 1]
        require(
            abs(fx / fy - 1) * self.height <= 1,
            "Camera.sensor()",
            "`K` must have equal focal lengths, because Mitsuba's sensor has one",
            f"{fx:g} and {fy:g}",
            f"render `camera.square()`, of {self.square().width}x{self.square().height} pixels, "
            "and resize the image",
        )
        # Mitsuba adds its offset to the pixel's position, so the principal point moves the other
        # way.
        return {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(self.to_world),
            "fov": float(self._fov_x),
            "fov_axis": "x",
            "principal_point_offset_x": float(0.5 - self.K[0, 2] / self.width),
            "principal_point_offset_y": float(0.5 - self.K[1, 2] / self.height),
            "near_clip": self.near,
            "far_clip": 1e4,
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "rfilter": {"type": "box"},
                "component_format": "float32",
                **film,
            },
        }


def intrinsics_of_fov(
    fov_x: float, width: int, height: int, offset_x: float = 0.0, offset_y: float = 0.0
) -> np.ndarray:
    """Return intrinsics [3, 3] of a field of view in degrees across, with Mitsuba's offsets."""
    f = 0.5 * width / np.tan(np.deg2rad(0.5 * fov_x))
    # Mitsuba adds its offset to the pixel's position, so the principal point moves the other way.
    return intrinsic_matrix(f, f, width * (0.5 - offset_x), height * (0.5 - offset_y))


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return intrinsics [3, 3] of focal lengths and a principal point in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def pose_at(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the extrinsics [4, 4] of a rotation [3, 3], world -> camera, at a position [3]."""
    return np.vstack([np.column_stack([rotation, -rotation @ position]), [0, 0, 0, 1.0]])


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return the directions of vectors [..., 3]."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rigid(where: str, matrix: np.ndarray) -> np.ndarray:
    """Return `matrix` [4, 4] (or [3, 4], completed) if it is a rotation and a translation.

    Raises:
        ValueError: it is not, in a sentence that begins with `where`.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    require(
        matrix.shape in ((3, 4), (4, 4)),
        where,
        "the pose must be a matrix [4, 4]",
        matrix.shape,
        "calibrate again",
    )
    require(
        bounded(matrix),
        where,
        f"the pose must be finite, with numbers of at most {LARGEST:g}",
        matrix.tolist(),
        "calibrate again",
    )
    R = matrix[:3, :3]
    require(
        # Files with six digits are off by 1e-6, scaled or sheared poses by far more than 1e-3.
        np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0,
        where,
        "the axes must be a right-handed orthonormal frame",
        R.round(4).tolist(),
        "undo any scaling or mirroring of the poses",
    )
    require(
        np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6),
        where,
        "the last row must be [0, 0, 0, 1]",
        matrix[3:].tolist(),
        "transpose the matrix if its translation is there",
    )
    return np.vstack([matrix[:3], [0, 0, 0, 1.0]])
