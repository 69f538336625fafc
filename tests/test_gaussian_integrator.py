"""The plugin `gaussian_splat`: what mi.render(scene, params) returns and differentiates."""

from __future__ import annotations

import logging
import subprocess
import sys
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, ellipsoids, rasterize
from tests import reference
from tests import tolerances as tol
from tests.render.test_rasterize import as_float32, make_camera, make_scene, relative, to_gaussians, twin

AOVS = "motion,confidence,depth"
# What Mitsuba optimises, and the derivative of its raw counterpart with respect to it.
ACTIVATED = {
    "log_scales": lambda raw: 1 / np.exp(raw["log_scales"]),
    "logit_opacities": lambda raw: 2 + 2 * np.cosh(raw["logit_opacities"]),
    "logit_confidence": lambda raw: 2 + 2 * np.cosh(raw["logit_confidence"]),
}


def make_raw(degree: int = 1) -> dict[str, np.ndarray]:
    """The rasteriser's test scene with unit quaternions, which Mitsuba wants."""
    raw = make_scene(degree)
    raw["quats"] /= np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    return as_float32(raw)


def make_view() -> Camera:
    """Mitsuba's sensors have one focal length; the principal point is off centre."""
    camera = make_camera()
    K = camera.K.copy()
    K[1, 1] = K[0, 0]
    return replace(camera, K=K)


def make_mitsuba_scene(gaussians, film=None, sensor=None, **props):
    return mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": {**make_view().sensor(**(film or {})), **(sensor or {})},
            "integrator": {"type": "gaussian_splat", **props},
        }
    )


def to_linear(color):
    """The sRGB transfer function, analytic for `complex_step`."""
    low = color.real <= 0.04045
    return np.where(low, color / 12.92, ((np.where(low, 1, color) + 0.055) / 1.055) ** 2.4)


def expected_image(raw, viewmat=None):
    """The float64 twin of an rgba film with all AOVs."""
    image = twin(raw, make_view(), viewmat=viewmat)
    parts = [to_linear(image["color"]), *(image[name] for name in ("alpha", "motion", "confidence", "depth"))]
    return np.concatenate(parts, axis=2)


def parameter_gradients(gradient, raw):
    """Turn a gradient by raw attribute into one by Mitsuba's parameter."""
    gradient = {name: g * ACTIVATED[name](raw) if name in ACTIVATED else g for name, g in gradient.items()}
    quats = np.roll(gradient["quats"], -1, axis=1)
    return {
        "gaussians.data": np.concatenate([gradient["means"], gradient["log_scales"], quats], axis=1).ravel(),
        "gaussians.opacities": gradient["logit_opacities"],
        "gaussians.sh_coeffs": gradient["sh_coeffs"].ravel(),
        "gaussians.motion": gradient["motion"].ravel(),
        "gaussians.confidence": gradient["logit_confidence"],
    }


@pytest.fixture(scope="module")
def raw():
    return make_raw()


@pytest.fixture(scope="module")
def weight(raw):
    """A random linear loss on all channels, where normalised ones do not divide by almost nothing."""
    solid = twin(raw, make_view())["alpha"] > 0.02
    return np.float32(np.random.default_rng(1).normal(size=(*solid.shape[:2], 8)) * solid)


@pytest.fixture(scope="module")
def gradients(raw, weight):
    """The loss's gradient by Mitsuba's parameters, exact to rounding."""
    expected = reference.complex_step(lambda values: np.sum(expected_image(values) * weight), raw, list(raw))
    return parameter_gradients(expected, raw)


# --------------------------------------------------------------------- image


@pytest.mark.parametrize("srgb_primitives", [True, False])
def test_image_is_the_rasterisers_in_linear_light(raw, srgb_primitives):
    gaussians = to_gaussians(raw)
    image = np.asarray(mi.render(make_mitsuba_scene(gaussians, srgb_primitives=srgb_primitives)))
    color = np.asarray(rasterize(gaussians, make_view()).color, np.float64)
    expected = to_linear(color) if srgb_primitives else color
    assert np.abs(image - expected).max() < tol.IMAGE_ABS


def test_all_channels_agree_with_twin_under_their_exr_names(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    image, expected = np.asarray(mi.render(scene)), expected_image(raw)
    solid = expected[..., 3:4] > 0.02
    assert np.abs((image - expected) * solid).max() < tol.IMAGE_ABS * np.abs(expected).max()
    fields = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    assert fields == ["R", "G", "B", "A", "motion.X", "motion.Y", "confidence.Y", "depth.Y"]


def test_aovs_come_in_the_order_asked_for(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=" depth, motion ")
    assert scene.integrator().aov_names() == ["depth.Y", "motion.X", "motion.Y"]
    image = rasterize(to_gaussians(raw), make_view(), ("depth", "motion"))
    expected = np.concatenate([np.asarray(image.depth), np.asarray(image.motion)], axis=2)
    # The sensor's angles and inverse pose are rounded on their way.
    solid = np.asarray(rasterize(to_gaussians(raw), make_view()).alpha) > 0.02
    assert np.abs((np.asarray(mi.render(scene))[..., 3:] - expected) * solid).max() < 5 * tol.IMAGE_ABS


def test_pixel_formats(raw):
    rgb = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw))))
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "luminance"}, aovs="confidence")
    luminance = np.asarray(mi.render(scene))
    assert luminance.shape == (*rgb.shape[:2], 2)
    assert np.abs(luminance[..., 0] - rgb @ (0.212671, 0.715160, 0.072169)).max() < tol.IMAGE_ABS


def test_crop_is_cut_out_of_the_full_image(raw):
    full = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)))
    crop = {"crop_offset_x": 5, "crop_offset_y": 7, "crop_width": 9, "crop_height": 4}
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), crop, aovs=AOVS)))
    np.testing.assert_array_equal(image, full[7:11, 5:14])


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
def test_field_of_view_along_any_axis(raw, axis):
    camera = make_view()
    W, H, f = camera.width, camera.height, camera.K[0, 0]
    extent = {"x": W, "y": H, "diagonal": np.hypot(W, H), "smaller": min(W, H), "larger": max(W, H)}[axis]
    sensor = {"fov_axis": axis, "fov": float(np.rad2deg(2 * np.arctan(0.5 * extent / f)))}
    image = mi.render(make_mitsuba_scene(to_gaussians(raw), sensor=sensor))
    expected = mi.render(make_mitsuba_scene(to_gaussians(raw)))
    assert np.abs(np.asarray(image) - np.asarray(expected)).max() < tol.IMAGE_ABS


def test_background_lies_behind(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), background={"type": "rgb", "value": [0.2, 0.5, 0.9]})
    color = np.asarray(rasterize(to_gaussians(raw), make_view(), background=(0.2, 0.5, 0.9)).color, np.float64)
    assert np.abs(np.asarray(mi.render(scene)) - to_linear(color)).max() < tol.IMAGE_ABS


@pytest.mark.parametrize("sample_border", [False, True])
def test_reconstruction_filter_weights_the_pixel_centres(raw, sample_border):
    crop = {"crop_offset_x": 4, "crop_offset_y": 5, "crop_width": 10, "crop_height": 8}
    film = {**crop, "rfilter": {"type": "gaussian", "stddev": 0.6}, "sample_border": sample_border}
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), film)))
    full = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw))))

    rfilter = mi.load_dict(film["rfilter"])
    b = rfilter.border_size() if sample_border else 0
    samples = full[5 - b : 13 + b, 4 - b : 14 + b]
    taps = np.array([rfilter.eval(mi.Float(d))[0] for d in range(-3, 4)])

    def blur(values):
        for axis in (0, 1):
            values = np.apply_along_axis(lambda line: np.convolve(line, taps, "same"), axis, values)
        return values

    expected = (blur(samples) / blur(np.ones_like(samples)))[b : b + 8, b : b + 10]
    # The border widens the view, and with it the region where splats are linearised at their own centre.
    assert np.abs(image - expected).max() < (1e-3 if sample_border else tol.IMAGE_ABS)


def test_several_shapes_of_several_degrees_are_one_cloud():
    raw = make_raw(degree=2)
    raw["sh_coeffs"][4:, 1:] = 0
    parts = [to_gaussians({k: v[s] for k, v in raw.items()}) for s in (slice(0, 4), slice(4, 7), slice(7, None))]
    parts[1] = replace(parts[1], sh_coeffs=parts[1].sh_coeffs[:, :1])
    parts[2] = replace(parts[2], sh_coeffs=parts[2].sh_coeffs[:, :4])
    scene = {f"shape{i}": ellipsoids(part) for i, part in enumerate(parts)}
    scene["shape1"]["type"] = "ellipsoidsmesh"
    integrator = {"type": "gaussian_splat", "aovs": AOVS}
    scene = mi.load_dict({"type": "scene", "sensor": make_view().sensor(), "integrator": integrator, **scene})
    one = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    assert np.abs(np.asarray(mi.render(scene)) - np.asarray(mi.render(one))).max() < tol.IMAGE_ABS

    params, expected = mi.traverse(scene), mi.traverse(one)
    for p, keys in ((params, ["shape0.data", "shape1.data", "shape2.data"]), (expected, ["gaussians.data"])):
        dr.enable_grad([p[key] for key in keys])
    for s, p in ((scene, params), (one, expected)):
        dr.backward(dr.sum(dr.square(mi.render(s, p)[..., :3]), axis=None))
    found = np.concatenate([np.asarray(dr.grad(params[f"shape{i}.data"])) for i in range(3)])
    assert relative(found, np.asarray(dr.grad(expected["gaussians.data"]))) < tol.GRADIENT_REL


def test_one_scene_renders_with_mitsubas_own_integrator_too():
    """Ray tracing knows no low-pass filter, no linearised projection and orders by entry: alike, not equal."""
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(20, 4))
    sh_coeffs = rng.normal(size=(20, 4, 3)) * 0.4
    gaussians = Gaussians.from_activated(
        rng.uniform(-1, 1, (20, 3)), rng.uniform(0.08, 0.2, (20, 3)), quats, rng.uniform(0.3, 0.8, 20), sh_coeffs
    )
    camera = Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 96, 72)
    shape = {**ellipsoids(gaussians), "extent": 3.5}
    scene = mi.load_dict({"type": "scene", "gaussians": shape, "sensor": camera.sensor()})
    splatted = np.asarray(mi.render(scene, integrator=mi.load_dict({"type": "gaussian_splat"})))
    traced = np.asarray(mi.render(scene, integrator=mi.load_dict({"type": "volprim_rf_basic"}), spp=16))
    psnr = -10 * np.log10(np.mean((splatted - traced) ** 2))
    assert psnr > 45  # 51 dB, of which Mitsuba's cut at `extent` standard deviations costs one


# ----------------------------------------------------------------- gradients


def test_backward_agrees_with_twin_for_every_parameter(raw, weight, gradients):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params = mi.traverse(scene)
    dr.enable_grad([params[name] for name in gradients])
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(weight), axis=None))
    for name, expected in gradients.items():
        assert relative(np.asarray(dr.grad(params[name])), expected) < tol.GRADIENT_REL, name


def test_forward_agrees_with_twin(raw, weight, gradients):
    """All parameters move at once; the loss's derivative is <gradient, direction>."""
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params, rng = mi.traverse(scene), np.random.default_rng(2)
    slope = 0.0
    for name, gradient in gradients.items():
        # The sign of the gradient as direction: no cancellation hides an error.
        direction = np.float32(np.sign(gradient) * rng.uniform(0.5, 1, gradient.shape))
        dr.enable_grad(params[name])
        dr.set_grad(params[name], mi.Float(direction))
        slope += np.vdot(gradient, direction)
    image = mi.render(scene, params)
    dr.forward_to(image)
    found = np.sum(np.asarray(dr.grad(image), np.float64) * weight)
    assert found == pytest.approx(slope, rel=tol.GRADIENT_REL)


def test_backward_agrees_with_central_differences(raw):
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    for name in ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs"):
        start = np.array(params[name])  # a copy: the parameter is a reference to what the scene holds
        dr.enable_grad(params[name])
        dr.backward(dr.sum(dr.square(mi.render(scene, params)), axis=None))
        gradient = np.asarray(dr.grad(params[name]), np.float64)
        direction = np.sign(gradient) * np.random.default_rng(4).uniform(0.5, 1, gradient.shape)
        losses = []
        for h in (1e-3, -1e-3):
            params[name] = mi.Float(np.float32(start + h * direction))
            params.update()
            losses.append(np.sum(np.asarray(mi.render(scene), np.float64) ** 2))
        params[name] = mi.Float(start)
        slope = (losses[0] - losses[1]) / 2e-3
        assert slope == pytest.approx(np.vdot(gradient, direction), rel=tol.CENTRAL_DIFFERENCE_REL), name


def test_gradient_of_the_sensors_pose(raw):
    """The camera moves to its left by t: to_world = M T(t), so viewmat moves its points to the right."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    params["sensor.to_world"] = params["sensor.to_world"] @ mi.AffineTransform4f().translate([t, 0, 0])
    params.update()
    dr.backward(dr.sum(dr.square(mi.render(scene, params)), axis=None))
    right = np.zeros((4, 4))
    right[0, 3] = 1
    viewmat = np.float32(make_view().viewmat).astype(np.float64)
    expected = reference.directional(
        lambda v: np.sum(expected_image(raw, v["viewmat"])[..., :3] ** 2), {"viewmat": viewmat}, {"viewmat": right}
    )
    assert dr.grad(t)[0] == pytest.approx(expected, rel=10 * tol.GRADIENT_REL)


def test_filter_and_crop_are_differentiated(raw):
    """<g, J v> = <J' g, v> through a film that blurs, crops and weighs."""
    film = {
        "rfilter": {"type": "gaussian"},
        "crop_offset_x": 3,
        "crop_offset_y": 2,
        "crop_width": 11,
        "crop_height": 12,
    }
    scene = make_mitsuba_scene(to_gaussians(raw), {**film, "pixel_format": "luminance_alpha"}, aovs=AOVS)
    params = mi.traverse(scene)
    data, rng = params["gaussians.data"], np.random.default_rng(5)
    g, v = (np.float32(rng.normal(size=s)) for s in ((12, 11, 6), dr.width(data)))
    dr.enable_grad(data)
    dr.set_grad(data, mi.Float(v))
    image = mi.render(scene, params)
    dr.forward_to(image)
    forward = np.vdot(np.asarray(dr.grad(image), np.float64), g)
    dr.set_grad(data, 0)
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(g), axis=None))
    assert np.vdot(np.asarray(dr.grad(data), np.float64), v) == pytest.approx(forward, rel=tol.DUALITY_REL)


# ---------------------------------------------------------------- as a plugin


def test_undeveloped_renders_can_be_written(raw, tmp_path):
    """The command `mitsuba scene.xml` asks for no tensor and writes the film."""
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    image = np.asarray(mi.render(scene))
    assert scene.integrator().render(scene, develop=False).shape == (0,)
    path = tmp_path / "image.exr"
    scene.sensors()[0].film().write(str(path))
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path)))[..., :3], image[..., :3])


def test_xml_scene_with_props(raw):
    text = """<integrator version="3.0.0" type="gaussian_splat">
        <string name="aovs" value="depth"/><boolean name="srgb_primitives" value="false"/>
        <rgb name="background" value="0.1, 0.2, 0.3"/>
    </integrator>"""
    integrator = mi.load_string(text)
    assert integrator.background == pytest.approx([0.1, 0.2, 0.3])
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw)), integrator=integrator))
    expected = np.asarray(rasterize(to_gaussians(raw), make_view(), background=(0.1, 0.2, 0.3)).color)
    assert np.abs(image[..., :3] - expected).max() < tol.IMAGE_ABS


def test_emitters_are_ignored_with_one_warning(raw, caplog):
    shape, sensor = ellipsoids(to_gaussians(raw)), make_view().sensor()
    scene = {"type": "scene", "gaussians": shape, "sensor": sensor, "integrator": {"type": "gaussian_splat"}}
    dark, lit = mi.load_dict(scene), mi.load_dict({**scene, "sky": {"type": "constant"}})
    with caplog.at_level(logging.WARNING):
        images = [np.asarray(mi.render(s)) for s in (dark, lit, lit)]
    np.testing.assert_array_equal(images[0], images[1])
    assert [r.getMessage().split(";")[0] for r in caplog.records] == ["gaussian_splat ignores the scene's emitters"]


def test_switching_variants_keeps_the_plugin_registered():
    """Importing before any variant is set works; a variant without derivatives is refused in words."""
    script = r"""
import morgs_mi, mitsuba as mi
for variant in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    try:
        integrator = mi.load_dict({"type": "gaussian_splat", "aovs": "depth"})
        print("\n>", variant, integrator.aov_names())
    except RuntimeError as error:
        print("\n>", variant, "ValueError: gaussian_splat: expected a variant such as 'llvm_ad_rgb'" in str(error))
"""
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert [line for line in found.splitlines() if line.startswith(">")] == [
        "> scalar_rgb True",
        "> llvm_ad_rgb ['depth.Y']",
        "> llvm_ad_mono ['depth.Y']",
        "> llvm_ad_rgb ['depth.Y']",
    ]


def test_reusing_a_shape_after_density_control(raw):
    """All attributes of a shape may change their length together."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    half = {name: value[:5] for name, value in raw.items()}
    shape = ellipsoids(to_gaussians(half))
    for name in ("data", "opacities", "sh_coeffs", "motion", "confidence"):
        params[f"gaussians.{name}"] = shape[name].array
    params.update()
    expected = to_linear(np.asarray(rasterize(to_gaussians(half), make_view()).color, np.float64))
    assert np.abs(np.asarray(mi.render(scene)) - expected).max() < tol.IMAGE_ABS


def with_shape(**changes):
    shape = {**ellipsoids(to_gaussians(make_raw())), **changes}
    return {"gaussians": {name: value for name, value in shape.items() if value is not None}}


def ones(*shape):
    return mi.TensorXf(np.ones(shape, np.float32))


BAD_SCENES = {
    "no shape": (lambda: {"gaussians": None}, {}, "expected a scene with an `ellipsoids` shape, got none"),
    "mesh": (lambda: {"wall": {"type": "rectangle"}}, {}, "expected `ellipsoids` shapes only, got Rectangle 'wall'"),
    "no opacities": (lambda: with_shape(opacities=None), {}, r"'gaussians' must carry `opacities` \[N, 1\] with N=10"),
    "no sh": (lambda: with_shape(sh_coeffs=None), {}, r"must carry `sh_coeffs` \[N, 3 or 12 or 27 or 48\]"),
    "odd sh": (lambda: with_shape(sh_coeffs=ones(10, 6)), {}, r"with N=10, got 60 values"),
    "no motion": (
        lambda: with_shape(motion=None),
        {"aovs": "motion"},
        r"`motion` \[N, 3\] with N=10, got only \['",
    ),
    "nan": (lambda: with_shape(opacities=ones(10, 1) * dr.nan), {}, r"`opacities` must be finite, got nan at \[0\]"),
    "thin lens": (
        lambda: {"sensor": {"type": "thinlens", "aperture_radius": 0.1}},
        {},
        "expected a `perspective` sensor, got ThinLensCamera",
    ),
    "orthographic": (lambda: {"sensor": {"type": "orthographic"}}, {}, "sensor, got OrthographicCamera"),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_say_what_was_expected(case):
    change, props, message = BAD_SCENES[case]
    scene = {"type": "scene", "sensor": make_view().sensor(), **with_shape(), **change()}
    scene = mi.load_dict({name: value for name, value in scene.items() if value is not None})
    integrator = mi.load_dict({"type": "gaussian_splat", **props})
    with pytest.raises(ValueError, match=message):
        integrator.render(scene)
    # mi.render wraps whatever an integrator raises.
    with pytest.raises(RuntimeError) as error:
        mi.render(scene, integrator=integrator)
    assert isinstance(error.value.__cause__, ValueError)


def test_films_of_other_quantities_than_rgb_are_refused():
    mi.set_variant("llvm_ad_spectral")
    film = {"type": "specfilm", "band": {"type": "spectrum", "value": [(400, 0.5), (700, 0.5)]}}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, **with_shape()})
    with pytest.raises(ValueError, match="expected an `hdrfilm`, got SpecFilm"):
        mi.load_dict({"type": "gaussian_splat"}).render(scene)


@pytest.mark.parametrize(
    ("props", "message"),
    [
        ({"aovs": "normal"}, "`aovs` must be out of motion, confidence, depth, got 'normal'"),
        ({"max_depth": 3}, "unreferenced property"),
        ({"background": [0.5, 0.5]}, "background"),
    ],
)
def test_bad_props_are_refused_when_the_scene_is_loaded(props, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "gaussian_splat", **props})
