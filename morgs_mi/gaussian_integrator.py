"""The Mitsuba integrators of this package: `gaussian_splat`, which renders the Gaussians of a scene
by rasterisation, and `splat_path` (see `extras.light`).

    "integrator": {"type": "gaussian_splat", "aovs": "motion,depth"}

`gaussian_splat` draws every `ellipsoids` (and `ellipsoidsmesh`) shape of a scene. It reads the
attributes that Mitsuba's `volprim_rf_basic` reads, so one scene file renders with both, though that
one traces rays and its images differ. N is the number of Gaussians of a shape, K = (degree + 1)^2:

    data [N, 10]          centre, standard deviations, unit quaternion xyzw
    opacities [N, 1]      in [0, 1]
    sh_coeffs [N, 3 K]    sRGB colour = max(0.5 + SH, 0), coefficient k of component j at 3 k + j
    motion [N, 3]         world units per frame; only for the AOV `motion`
    confidence [N, 1]     in [0, 1]; only for the AOV `confidence`

Every attribute with a `channel` in `core.attributes` is an AOV like `confidence`.

With an integrator for `surfaces`, the other shapes of the scene are drawn among the Gaussians:

    "integrator": {"type": "gaussian_splat", "surfaces": {"type": "path"}}

`mi.render(scene, params)` is differentiable, in forward and reverse mode, in these attributes, in
the `background`, and in the sensor's `to_world`, `x_fov` and `principal_point_offset_x`, `_y`; with
surfaces rendered by `prb` or similar also in their materials and lights.

Importing this module registers the plugins with the active variant and with every variant set
later.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, owned_copy
from morgs_mi.core.attributes import shape_attribute_widths
from morgs_mi.core.gaussians import ActivatedGaussians, require_some
from morgs_mi.core.types import SceneDict
from morgs_mi.platform.checks import check_type, require
from morgs_mi.platform.extras import enter, extra, places

# The class of a plugin, as extras enter theirs.
enter(
    "morgs_mi.surfaces",
    "integrators",
    {"gaussian_splat": "gaussian_splat:GaussianSplatIntegrator"},
)


def ellipsoids(gaussians: ActivatedGaussians) -> SceneDict:
    """Return the dictionary of an `ellipsoids` shape with a copy of N Gaussians' activated
    attributes.

    Optimise the parameters of the scene: gradients do not reach `gaussians`.

    Example:
        >>> integrator = {"type": "gaussian_splat"}
        >>> scene = mi.load_dict({"type": "scene", "gaussians": morgs_mi.ellipsoids(gaussians),
        ...                       "sensor": camera.sensor(), "integrator": integrator})
        >>> image = mi.render(scene)

    Raises:
        ValueError: there are no Gaussians. (Mitsuba would end the process.)
    """
    require_some("ellipsoids()", gaussians, "leave the shape out of the scene")
    names = ("means", "scales", "quats", *shape_attribute_widths())
    values = {name: getattr(gaussians, name, None) for name in names}
    values = {
        name: np.array(dr.detach(value)) for name, value in values.items() if value is not None
    }
    means, scales, quats = map(values.pop, names[:3])
    # Mitsuba expects unit quaternions.
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    data = np.concatenate([means, scales, np.roll(quats, -1, axis=1)], axis=1)
    # Memory of Dr.Jit: a parameter that is borrowed from NumPy cannot be replaced in a function
    # under `dr.freeze`.
    return {"type": "ellipsoids"} | {
        name: mi.TensorXf(
            owned_copy(from_numpy(mi.Float, value)), (len(data), value.size // len(data))
        )
        for name, value in {"data": data, **values}.items()
    }


def update_ellipsoids(params: Any, gaussians: ActivatedGaussians, shape: str = "gaussians") -> None:
    """Write N Gaussians into an `ellipsoids` shape of a scene and update it; gradients of its
    images reach them.

    Args:
        params: of the scene, from `mi.traverse`.
        gaussians: N Gaussians; N may have changed.
        shape: name of the shape.

    Raises:
        ValueError: the scene has no such shape, there are no Gaussians, or they lack an attribute
            that the shape has.
    """
    place = "update_ellipsoids()"
    check_type(place, "params", params, mi.SceneParameters, "pass mi.traverse(scene)")
    require(
        f"{shape}.data" in params,
        place,
        f"`params` must have {shape}.data",
        "none",
        "name the shape that morgs_mi.ellipsoids() made",
    )
    require_some(place, gaussians, "remove the shape from the scene")
    names = [name for name in shape_attribute_widths() if f"{shape}.{name}" in params]
    for name in names:
        require(
            getattr(gaussians, name, None) is not None,
            place,
            f"`gaussians` must have `{name}`, as the shape has",
            "none",
            "set it, or load the scene again with a shape that has none",
        )
    quats: Any = gaussians.quats
    length = dr.maximum(dr.sum(dr.square(quats), axis=1), 1e-30)
    xyzw = (quats * dr.rsqrt(length)[:, None])[:, mi.UInt32(1, 2, 3, 0)]
    params[f"{shape}.data"] = dr.concat([gaussians.means, gaussians.scales, xyzw], axis=1).array
    for name in names:
        params[f"{shape}.{name}"] = getattr(gaussians, name).array
    params.update()


def integrator(plugin: str, props: Any) -> Any:
    """Return an integrator of the active variant; `plugin` is its type, `props` are its properties.

    In a variant without derivatives, such as `scalar_rgb`, it refuses to render.

    Raises:
        ValueError: the plugin is an extra's that is not there.
    """
    if dr.is_diff_v(mi.Float):
        return extra("integrators", plugin)(props)
    variant = mi.variant()

    # Mitsuba would report an error of a constructor as a traceback inside another one.

    class Refusal(mi.CppADIntegrator):
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            for name in props.unqueried():  # Mitsuba refuses properties that nothing reads
                props[name]

        def render(self, *_: Any, **__: Any) -> Any:
            raise ValueError(
                f"{plugin}: expected a variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb', got "
                f"{variant!r}; call mi.set_variant() before the scene is loaded."
            )

    return Refusal(props)


def _register(*_arguments: Any) -> None:
    """Register the plugins with the active variant."""
    for plugin, place in places("integrators").items():
        # Its class is defined again, with the base class of this variant, when it is next used.
        sys.modules.pop(place.partition(":")[0], None)
        mi.register_integrator(plugin, partial(integrator, plugin))


mi.detail.add_variant_callback(_register)
if mi.variant() is not None:
    _register()
