"""The Mitsuba integrator `splat_path`: paths among surfaces, along which the Gaussians emit and
absorb light.

    "integrator": {"type": "gaussian_splat", "surfaces": {"type": "splat_path"}}

The Gaussians on a segment of a path act as one layer. C and T are their blended colour and
transmittance, and L is the radiance that arrives from behind:

    (1 - T) dec(C / (1 - T)) + T L

`dec` decodes colours to linear light. The layer is linear in L: estimates of L may be noisy, and
lights shine through it by the factor T, from whichever side they are found. It is left out between
the camera and the first surface: there, `gaussian_splat` blends the splats.

Derivatives are computed by path replay (Vicini et al. 2021), with the layers as constants.

Mitsuba has a base class for every variant, so this module is imported again after mi.set_variant().
"""

from __future__ import annotations

from importlib import reload
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
from annotated_types import Ge
from mitsuba.ad.integrators import common  # pyright: ignore

from morgs_mi.core.types import Bool, Color3f, Float
from morgs_mi.extras.light.light_probe import CLIPPED, radiance
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import Count, check_value
from morgs_mi.surfaces.splat_rays import SplatRays

# Mitsuba reloads this module when one of its own integrators is first used in another variant.
reload(common)

_PROPERTIES = {
    "max_depth": Annotated[int, Ge(-1)],
    "rr_depth": Count,
    "clipped": Annotated[float, Ge(1)],
}


class SplatPathIntegrator(common.RBIntegrator):
    r"""Path tracer for surfaces among Gaussians (:monosp:`splat_path`), the `surfaces` of a
    `gaussian_splat`.

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path, in segments; -1: any length. (Default: 6)

     * - rr_depth
       - |int|
       - Segments after which Russian roulette may end a path. (Default: 5)

     * - clipped
       - |float|
       - Radiance of colours that the video clipped at 1, as for `light_probe`. (Default: 4)

     * - hide_emitters
       - |bool|
       - Whether the camera does not see the environment. (Default: False)

    Differentiable in materials and lights. Positions of surfaces, and the Gaussians along paths,
    get no gradient.
    """

    def __init__(self, props: Any) -> None:
        for name, kind in _PROPERTIES.items():
            if name in props:
                check_value("splat_path", name, props[name], kind)
        super().__init__(props)
        self.clipped = float(props.get("clipped", CLIPPED))
        self.splats: SplatRays | None = None
        self.srgb = True

    @dr.syntax
    def sample(
        self,
        mode: dr.ADMode,
        scene: Any,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        δL: Color3f = None,
        state_in: Any = None,
        active: Bool = True,
        **_: Any,
    ) -> tuple[Any, Bool, list[Float], Any]:
        """Return radiance or its derivative, as `ADIntegrator.sample` does."""
        require(
            self.splats,
            "splat_path",
            "expected Gaussians",
            "none",
            "set it as the `surfaces` of a `gaussian_splat`, which passes its own",
        )
        primal = mode == dr.ADMode.Primal
        ctx = mi.BSDFContext()
        sign = 1 if primal else -1

        ray = mi.Ray3f(dr.detach(ray))
        depth = mi.UInt32(0)  # number of segments that ended on a surface
        L = mi.Spectrum(0 if primal else state_in)  # radiance; in the second pass, what is left
        δL = mi.Spectrum(0 if δL is None else δL)  # its derivative
        β = mi.Spectrum(1)  # throughput
        η = mi.Float(1)  # ratio of the indices of refraction
        active = mi.Bool(active)
        # The surface that the segment leaves, the density of its direction there, and whether the
        # direction had no choice.
        last_si = dr.zeros(mi.SurfaceInteraction3f)
        last_pdf = mi.Float(1)
        last_is_delta = mi.Bool(True)

        while dr.hint(active, label=f"splat_path ({mode.name})"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            bsdf = si.bsdf(ray)

            # --------------------- Gaussians on the segment ---------------------

            ray.maxt = dr.select(si.is_valid(), si.t, dr.largest(mi.Float))
            emission, transmittance = self._layer(ray, active & (depth > 0))
            L += sign * β * emission
            β *= transmittance

            # ------------------------- Direct emission --------------------------

            visible = active & ~((depth == 0) & ~si.is_valid()) if self.hide_emitters else active
            ds = mi.DirectionSample3f(scene, si, last_si)
            mis = common.mis_weight(
                last_pdf, scene.pdf_emitter_direction(last_si, ds, ~last_is_delta)
            )
            with dr.resume_grad(when=not primal):
                Le = β * mis * ds.emitter.eval(si, visible)

            # ------------------------- Emitter sampling -------------------------

            proceed = active & (depth + 1 < self.max_depth) & si.is_valid()
            with_light = proceed & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, weight = scene.sample_emitter_direction(
                si, sampler.next_2d(with_light), True, with_light
            )
            with_light &= ds.pdf != 0
            weight *= self._to_light(
                si, ds, with_light & (dr.max(mi.unpolarized_spectrum(weight)) > 0)
            )
            wo = si.to_local(ds.d)
            with dr.resume_grad(when=not primal):
                if dr.hint(not primal, mode="scalar"):
                    attached = scene.eval_emitter_direction(si, ds, with_light)
                    weight = weight * dr.relative_grad(attached)
                value, pdf = bsdf.eval_pdf(ctx, si, wo, with_light)
                Ld = β * dr.select(ds.delta, 1, common.mis_weight(ds.pdf, pdf)) * value * weight

            # -------------------------- BSDF sampling ---------------------------

            direction_sample, scale = bsdf.sample(
                ctx, si, sampler.next_1d(proceed), sampler.next_2d(proceed), proceed
            )
            L += sign * dr.detach(Le + Ld)
            with dr.resume_grad(when=not primal):
                if dr.hint(not primal, mode="scalar"):
                    onward = L * dr.relative_grad(bsdf.eval(ctx, si, direction_sample.wo, proceed))
                    Lo = Le + Ld + onward
                    # Not attached where positions alone are differentiated.
                    if dr.hint(dr.grad_enabled(Lo), mode="scalar"):
                        if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                            dr.backward_from(δL * Lo)
                        else:
                            δL += dr.forward_to(Lo)
            β *= scale
            η *= direction_sample.eta
            ray = si.spawn_ray(si.to_world(direction_sample.wo))

            # ------------------------ Stopping criterion ------------------------

            largest = dr.max(mi.unpolarized_spectrum(β))
            survival = dr.minimum(largest * dr.square(η), 0.95)
            roulette = depth >= self.rr_depth
            proceed &= (largest > 0) & (~roulette | (sampler.next_1d(proceed) < survival))
            β = dr.select(roulette, β * dr.rcp(survival), β)
            last_is_delta = mi.has_flag(direction_sample.sampled_type, mi.BSDFFlags.Delta)
            last_pdf = direction_sample.pdf
            last_si = dr.detach(si)
            depth = dr.select(si.is_valid(), depth + 1, depth)
            active = proceed
        return L if primal else δL, depth != 0, [], L

    def _layer(self, ray: mi.Ray3f, active: Bool) -> tuple[Any, Float]:
        """Return the radiance that the Gaussians on a segment emit, and their transmittance."""
        assert self.splats
        color, transmittance = self.splats.trace(ray, active)
        alpha = 1 - transmittance
        mean = color * dr.select(alpha > 0, dr.rcp(alpha), 0)
        return alpha * radiance(mean, self.clipped, self.srgb), transmittance

    def _to_light(self, si: mi.SurfaceInteraction3f, ds: Any, active: Bool) -> Float:
        """Return the transmittance between a surface and a sampled light."""
        assert self.splats
        ray = si.spawn_ray_to(ds.p)
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ray.d = ds.d
        ray.maxt = dr.select(far, dr.largest(mi.Float), ds.dist)
        return self.splats.transmittance(ray, active)

    def to_string(self) -> str:
        return f"SplatPathIntegrator[max_depth = {self.max_depth}, clipped = {self.clipped}]"
