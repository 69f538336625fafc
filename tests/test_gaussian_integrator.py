"""The plugin `gaussian_splat`: images and derivatives of mi.render(scene, params)."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, ellipsoids, rasterize
from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.io.ply import write_ply
from tests import reference
from tests import tolerances as tol
from tests.assertions import assert_close
from tests.reference import rasterize_view
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.gaussians import NEW_ATTRIBUTES, ExtendedGaussians, make_unit_scene, to_gaussians
from tests.scenes.plugin import AOVS, make_mitsuba_scene

# Raw attributes, and their derivatives with respect to the activated parameters of a Mitsuba scene.
ACTIVATED = {
    "log_scales": lambda raw: 1 / np.exp(raw["log_scales"]),
    "logit_opacities": lambda raw: 2 + 2 * np.cosh(raw["logit_opacities"]),
    "logit_confidence": lambda raw: 2 + 2 * np.cosh(raw["logit_confidence"]),
}


def to_linear(color):
    """Return the linear light of an sRGB-encoded colour, analytic for `complex_step`."""
    low = color.real <= 0.04045
    return np.where(low, color / 12.92, ((np.where(low, 1, color) + 0.055) / 1.055) ** 2.4)


def expected_image(raw, viewmat=None):
    """Return the reference image of an rgba film with all AOVs."""
    image = rasterize_view(raw, make_sensor_camera(), viewmat=viewmat)
    parts = [to_linear(image["color"]), *(image[name] for name in ("alpha", "motion", "confidence", "depth"))]
    return np.concatenate(parts, axis=2)


def parameter_gradients(gradient, raw):
    """Return the gradient with respect to Mitsuba's parameters from the one with respect to raw attributes."""
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
    return make_unit_scene()


@pytest.fixture(scope="module")
def weight(raw):
    """A random linear loss on all channels, where normalised channels do not divide by a small alpha."""
    solid = rasterize_view(raw, make_sensor_camera())["alpha"] > 0.02
    return np.float32(np.random.default_rng(1).normal(size=(*solid.shape[:2], 8)) * solid)


@pytest.fixture(scope="module")
def gradients(raw, weight):
    """The loss's gradient by Mitsuba's parameters, exact to rounding."""
    expected = reference.complex_step(lambda values: np.sum(expected_image(values) * weight), raw, list(raw))
    return parameter_gradients(expected, raw)


# --------------------------------------------------------------------- image


@pytest.mark.parametrize("srgb_primitives", [True, False])
def test_gaussian_splat__image_is_the_rasterisers_in_linear_light(raw, srgb_primitives):
    gaussians = to_gaussians(raw)
    image = np.asarray(mi.render(make_mitsuba_scene(gaussians, srgb_primitives=srgb_primitives)))
    color = np.asarray(rasterize(gaussians, make_sensor_camera()).color, np.float64)
    expected = to_linear(color) if srgb_primitives else color
    assert_close(image, expected, atol=tol.IMAGE_ABS)


def test_gaussian_splat__channels_agree_with_the_reference_under_their_exr_names(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    image, expected = np.asarray(mi.render(scene)), expected_image(raw)
    solid = expected[..., 3:4] > 0.02
    assert_close(image, expected, atol=tol.IMAGE_ABS * np.abs(expected).max(), where=solid)
    fields = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    assert fields == ["R", "G", "B", "A", "motion.X", "motion.Y", "confidence.Y", "depth.Y"]


def test_gaussian_splat__writes_aovs_in_the_requested_order(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=" depth, motion ")
    assert scene.integrator().aov_names() == ["depth.Y", "motion.X", "motion.Y"]
    image = rasterize(to_gaussians(raw), make_sensor_camera(), ("depth", "motion"))
    expected = np.concatenate([np.asarray(image.depth), np.asarray(image.motion)], axis=2)
    # The sensor's angles and inverse pose are rounded.
    solid = np.asarray(rasterize(to_gaussians(raw), make_sensor_camera()).alpha) > 0.02
    assert_close(np.asarray(mi.render(scene))[..., 3:], expected, atol=5 * tol.IMAGE_ABS, where=solid)


def test_gaussian_splat__supports_pixel_formats(raw):
    rgb = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw))))
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "luminance"}, aovs="confidence")
    luminance = np.asarray(mi.render(scene))
    assert luminance.shape == (*rgb.shape[:2], 2)
    assert_close(luminance[..., 0], rgb @ (0.212671, 0.715160, 0.072169), atol=tol.IMAGE_ABS)


def test_gaussian_splat__crop_equals_that_of_the_full_image(raw):
    full = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)))
    crop = {"crop_offset_x": 5, "crop_offset_y": 7, "crop_width": 9, "crop_height": 4}
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), crop, aovs=AOVS)))
    np.testing.assert_array_equal(image, full[7:11, 5:14])


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
def test_gaussian_splat__supports_a_field_of_view_along_any_axis(raw, axis):
    camera = make_sensor_camera()
    W, H, f = camera.width, camera.height, camera.K[0, 0]
    extent = {"x": W, "y": H, "diagonal": np.hypot(W, H), "smaller": min(W, H), "larger": max(W, H)}[axis]
    sensor = {"fov_axis": axis, "fov": float(np.rad2deg(2 * np.arctan(0.5 * extent / f)))}
    image = mi.render(make_mitsuba_scene(to_gaussians(raw), sensor=sensor))
    expected = mi.render(make_mitsuba_scene(to_gaussians(raw)))
    assert_close(image, expected, atol=tol.IMAGE_ABS)


def test_gaussian_splat__composites_over_the_background(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), background={"type": "rgb", "value": [0.2, 0.5, 0.9]})
    color = np.asarray(rasterize(to_gaussians(raw), make_sensor_camera(), background=(0.2, 0.5, 0.9)).color, np.float64)
    assert_close(mi.render(scene), to_linear(color), atol=tol.IMAGE_ABS)


@pytest.mark.parametrize("sample_border", [False, True])
def test_gaussian_splat__reconstruction_filter_weights_the_pixel_centres(raw, sample_border):
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
    # The border enlarges the view, and with it the region where splats are linearised at their own centre.
    assert_close(image, expected, atol=1e-3 if sample_border else tol.IMAGE_ABS)


def test_gaussian_splat__renders_shapes_of_several_degrees_as_one_cloud():
    raw = make_unit_scene(degree=2)
    raw["sh_coeffs"][4:, 1:] = 0
    parts = [to_gaussians({k: v[s] for k, v in raw.items()}) for s in (slice(0, 4), slice(4, 7), slice(7, None))]
    parts[1] = replace(parts[1], sh_coeffs=parts[1].sh_coeffs[:, :1])
    parts[2] = replace(parts[2], sh_coeffs=parts[2].sh_coeffs[:, :4])
    scene = {f"shape{i}": ellipsoids(part) for i, part in enumerate(parts)}
    scene["shape1"]["type"] = "ellipsoidsmesh"
    integrator = {"type": "gaussian_splat", "aovs": AOVS}
    scene = mi.load_dict({"type": "scene", "sensor": make_sensor_camera().sensor(), "integrator": integrator, **scene})
    one = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    assert_close(mi.render(scene), mi.render(one), atol=tol.IMAGE_ABS)

    params, expected = mi.traverse(scene), mi.traverse(one)
    for p, keys in ((params, ["shape0.data", "shape1.data", "shape2.data"]), (expected, ["gaussians.data"])):
        dr.enable_grad([p[key] for key in keys])
    for s, p in ((scene, params), (one, expected)):
        dr.backward(dr.sum(dr.square(mi.render(s, p)[..., :3]), axis=None))
    found = np.concatenate([np.asarray(dr.grad(params[f"shape{i}.data"])) for i in range(3)])
    assert_close(found, dr.grad(expected["gaussians.data"]), rtol=tol.GRADIENT_REL)


def test_gaussian_splat__agrees_with_mitsubas_own_integrator():
    """Ray tracing has no low-pass filter, no linearised projection and orders by entry: similar, not equal."""
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
    assert psnr > 45  # 51 dB, of which Mitsuba's cut-off at `extent` standard deviations costs one


def test_gaussian_splat__renders_a_new_attribute_of_the_table(raw, monkeypatch):
    """Every attribute with a channel is a shape attribute and an AOV."""
    for attribute in NEW_ATTRIBUTES:
        monkeypatch.setitem(BY_ACTIVATED_NAME, attribute.activated_name, attribute)
    normals = np.float32(np.random.default_rng(6).normal(size=(len(raw["means"]), 3)))
    gaussians = ExtendedGaussians(**raw, logit_roughness=raw["logit_confidence"], normals=normals)
    scene = make_mitsuba_scene(gaussians, aovs="roughness,confidence,normal")
    assert scene.integrator().aov_names() == ["roughness.Y", "confidence.Y", "normal.X", "normal.Y", "normal.Z"]
    image = np.asarray(mi.render(scene))
    assert np.abs(image[..., 3]).max() > 0
    assert_close(image[..., 3], image[..., 4])
    assert_close(image[..., 5:], rasterize(gaussians, make_sensor_camera(), ("normal",))["normal"], atol=tol.IMAGE_ABS)
    integrator, bare = (
        mi.load_dict({"type": "gaussian_splat", "aovs": "roughness"}),
        make_mitsuba_scene(to_gaussians(raw)),
    )
    with pytest.raises(ValueError, match=r"must have `roughness` \[N, 1\] with N=10, got only"):
        integrator.render(bare)


# ----------------------------------------------------------------- gradients


def test_gaussian_splat__backward_agrees_with_the_reference_for_every_parameter(raw, weight, gradients):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params = mi.traverse(scene)
    dr.enable_grad([params[name] for name in gradients])
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(weight), axis=None))
    for name, expected in gradients.items():
        assert_close(dr.grad(params[name]), expected, rtol=tol.GRADIENT_REL, name=name)


def test_gaussian_splat__forward_agrees_with_the_reference(raw, weight, gradients):
    """All parameters change at once; the derivative of the loss is <gradient, direction>."""
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params, rng = mi.traverse(scene), np.random.default_rng(2)
    slope = 0.0
    for name, gradient in gradients.items():
        # The direction is the sign of the gradient, so that no cancellation hides an error.
        direction = np.float32(np.sign(gradient) * rng.uniform(0.5, 1, gradient.shape))
        dr.enable_grad(params[name])
        dr.set_grad(params[name], mi.Float(direction))
        slope += np.vdot(gradient, direction)
    image = mi.render(scene, params)
    dr.forward_to(image)
    found = np.sum(np.asarray(dr.grad(image), np.float64) * weight)
    assert found == pytest.approx(slope, rel=tol.GRADIENT_REL)


def test_gaussian_splat__backward_agrees_with_central_differences(raw):
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    for name in ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs"):
        start = np.array(params[name])  # a copy: the parameter is a reference to the scene's array
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


def test_gaussian_splat__gradient_of_the_sensors_pose(raw):
    """The camera moves to its left by t: to_world = M T(t), so that viewmat moves points to the right."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    params["sensor.to_world"] = params["sensor.to_world"] @ mi.AffineTransform4f().translate([t, 0, 0])
    params.update()
    dr.backward(dr.sum(dr.square(mi.render(scene, params)), axis=None))
    right = np.zeros((4, 4))
    right[0, 3] = 1
    viewmat = np.float32(make_sensor_camera().viewmat).astype(np.float64)
    expected = reference.directional(
        lambda v: np.sum(expected_image(raw, v["viewmat"])[..., :3] ** 2), {"viewmat": viewmat}, {"viewmat": right}
    )
    assert dr.grad(t)[0] == pytest.approx(expected, rel=10 * tol.GRADIENT_REL)


def test_gaussian_splat__differentiates_filter_and_crop(raw):
    """<g, J v> = <J' g, v> through a film that blurs, crops and normalises."""
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


def test_gaussian_splat__writes_undeveloped_renders(raw, tmp_path):
    """The command `mitsuba scene.xml` requests no tensor and writes the film."""
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    image = np.asarray(mi.render(scene))
    assert scene.integrator().render(scene, develop=False).shape == (0,)
    path = tmp_path / "image.exr"
    scene.sensors()[0].film().write(str(path))
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path)))[..., :3], image[..., :3])


def test_gaussian_splat__reads_props_of_an_xml_scene(raw):
    text = """<integrator version="3.0.0" type="gaussian_splat">
        <string name="aovs" value="depth"/><boolean name="srgb_primitives" value="false"/>
        <rgb name="background" value="0.1, 0.2, 0.3"/>
    </integrator>"""
    integrator = mi.load_string(text)
    assert integrator.background == pytest.approx([0.1, 0.2, 0.3])
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw)), integrator=integrator))
    expected = np.asarray(rasterize(to_gaussians(raw), make_sensor_camera(), background=(0.1, 0.2, 0.3)).color)
    assert_close(image[..., :3], expected, atol=tol.IMAGE_ABS)


def test_gaussian_splat__ignores_emitters_with_one_warning(raw, caplog):
    shape, sensor = ellipsoids(to_gaussians(raw)), make_sensor_camera().sensor()
    scene = {"type": "scene", "gaussians": shape, "sensor": sensor, "integrator": {"type": "gaussian_splat"}}
    dark, lit = mi.load_dict(scene), mi.load_dict({**scene, "sky": {"type": "constant"}})
    with caplog.at_level(logging.WARNING):
        images = [np.asarray(mi.render(s)) for s in (dark, lit, lit)]
    np.testing.assert_array_equal(images[0], images[1])
    assert [r.getMessage().split(";")[0] for r in caplog.records] == ["gaussian_splat ignores the scene's emitters"]


def test_gaussian_splat__stays_registered_when_variants_are_switched():
    """Importing before any variant is set works; a variant without derivatives is refused with an explanation."""
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


def test_gaussian_splat__renders_a_shape_after_density_control(raw):
    """All attributes of a shape may change their length together."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    half = {name: value[:5] for name, value in raw.items()}
    shape = ellipsoids(to_gaussians(half))
    for name in ("data", "opacities", "sh_coeffs", "motion", "confidence"):
        params[f"gaussians.{name}"] = shape[name].array
    params.update()
    expected = to_linear(np.asarray(rasterize(to_gaussians(half), make_sensor_camera()).color, np.float64))
    assert_close(mi.render(scene), expected, atol=tol.IMAGE_ABS)


def with_shape(**changes):
    shape = {**ellipsoids(to_gaussians(make_unit_scene())), **changes}
    return {"gaussians": {name: value for name, value in shape.items() if value is not None}}


def ones(*shape):
    return mi.TensorXf(np.ones(shape, np.float32))


BAD_SCENES = {
    "no shape": (lambda: {"gaussians": None}, {}, "expected a scene with an `ellipsoids` shape, got none"),
    "mesh": (lambda: {"wall": {"type": "rectangle"}}, {}, "expected `ellipsoids` shapes only, got Rectangle 'wall'"),
    "no opacities": (lambda: with_shape(opacities=None), {}, r"'gaussians' must have `opacities` \[N, 1\] with N=10"),
    "no sh": (lambda: with_shape(sh_coeffs=None), {}, r"must have `sh_coeffs` \[N, 3 or 12 or 27 or 48\]"),
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
def test_gaussian_splat__refuses_bad_scenes(case):
    change, props, message = BAD_SCENES[case]
    scene = {"type": "scene", "sensor": make_sensor_camera().sensor(), **with_shape(), **change()}
    scene = mi.load_dict({name: value for name, value in scene.items() if value is not None})
    integrator = mi.load_dict({"type": "gaussian_splat", **props})
    with pytest.raises(ValueError, match=message):
        integrator.render(scene)
    # mi.render wraps the errors of an integrator.
    with pytest.raises(RuntimeError) as error:
        mi.render(scene, integrator=integrator)
    assert isinstance(error.value.__cause__, ValueError)


def test_gaussian_splat__refuses_films_other_than_rgb():
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
def test_gaussian_splat__refuses_bad_props_when_the_scene_is_loaded(props, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "gaussian_splat", **props})


def test_ellipsoids__refuse_no_gaussians(raw):
    with pytest.raises(ValueError, match="at least one Gaussian"):
        ellipsoids(to_gaussians({name: value[:0] for name, value in raw.items()}))


SCENE_FILE = """<scene version="3.0.0">
    <integrator type="gaussian_splat"/>
    <shape type="ellipsoids"><string name="filename" value="gaussians.ply"/></shape>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="16"/></film>
    </sensor>
</scene>"""


def test_gaussian_splat__renders_a_scene_file_as_the_limits_describe(tmp_path, raw):
    """The command `mitsuba` does not find the plugin; the Python command in docs/limits.md renders the same file."""
    write_ply(tmp_path / "gaussians.ply", to_gaussians(raw))
    (tmp_path / "scene.xml").write_text(SCENE_FILE)
    page = (Path(__file__).parents[1] / "docs/limits.md").read_text(encoding="utf-8")
    command = textwrap.dedent(re.findall(r"```bash\n(.*?)```", page, re.DOTALL)[0])
    program = re.search(r'python -c "\n(.*?)"', command, re.DOTALL)[1]
    subprocess.run([sys.executable, "-c", program], check=True, cwd=tmp_path, timeout=120)
    image = np.array(mi.Bitmap(str(tmp_path / "image.exr")))
    assert image.shape[:2] == (16, 32)
    expected = np.array(mi.render(mi.load_file(str(tmp_path / "scene.xml"))))
    assert expected.max() > 0.1
    assert_close(image[..., :3], expected[..., :3], atol=2e-3)  # half precision
