"""The plugin `gaussian_splat`: images of mi.render(scene)."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import Camera, Gaussians, RenderConfig, ellipsoids, rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.gaussian_integrator.expected import expected_image, to_linear
from tests.reference import rasterize_view
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import ExtendedGaussians, make_unit_scene, to_gaussians
from tests.scenes.plugin import AOVS, make_mitsuba_scene, plugin_image


@pytest.mark.parametrize("srgb_primitives", [True, False])
def test_gaussian_splat__image_is_the_rasterisers_in_linear_light(raw, srgb_primitives):
    image = plugin_image(raw, srgb_primitives=srgb_primitives)
    color = np.asarray(rasterize(to_gaussians(raw), make_sensor_camera()).color, np.float64)
    expected = to_linear(color) if srgb_primitives else color
    assert_close(image, expected, atol=tol.IMAGE_ABS)


@pytest.mark.parametrize(
    "settings",
    [
        {"eps2d": 1.5},
        {"alpha_min": 0.2},
        {"stop_transmittance": 0.999},
        {"antialiased": True},
        {"first_order_motion": True},
    ],
    ids=lambda settings: next(iter(settings)),
)
def test_gaussian_splat__has_the_settings_of_the_rasteriser(raw, settings):
    image = plugin_image(raw, srgb_primitives=False, aovs="motion", **settings)
    by_default = plugin_image(raw, srgb_primitives=False, aovs="motion")
    channels = ("color", "motion")
    config = RenderConfig(**settings)
    expected = rasterize(to_gaussians(raw), make_sensor_camera(), channels, config=config)
    assert_close(
        image, np.concatenate([expected.color, expected.motion], axis=2), atol=tol.IMAGE_ABS
    )
    assert np.abs(image - by_default).max() > 1e-3


def test_gaussian_splat__channels_agree_with_the_reference_under_their_exr_names(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    image = np.asarray(mi.render(scene))
    expected = expected_image(raw)
    solid = expected[..., 3:4] > 0.02
    assert_close(image, expected, atol=tol.IMAGE_ABS * np.abs(expected).max(), where=solid)
    fields = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    assert fields == ["R", "G", "B", "A", "motion.X", "motion.Y", "confidence.Y", "depth.Y"]


def test_gaussian_splat__writes_aovs_in_the_requested_order(raw):
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=" depth, motion ")
    assert scene.integrator().aov_names() == ["depth.Y", "motion.X", "motion.Y"]
    image = np.asarray(mi.render(scene))
    assert_array_equal(image[..., 3:], plugin_image(raw, aovs=AOVS)[..., [6, 3, 4]])


def test_gaussian_splat__supports_pixel_formats(raw):
    rgb = plugin_image(raw)
    luminance = plugin_image(raw, {"pixel_format": "luminance"}, aovs="confidence")
    assert luminance.shape == (*rgb.shape[:2], 2)
    assert_close(luminance[..., 0], rgb @ (0.212671, 0.715160, 0.072169), atol=tol.IMAGE_ABS)


def test_gaussian_splat__crop_equals_that_of_the_full_image(raw):
    full = plugin_image(raw, aovs=AOVS)
    crop = {"crop_offset_x": 5, "crop_offset_y": 7, "crop_width": 9, "crop_height": 4}
    assert_array_equal(plugin_image(raw, crop, aovs=AOVS), full[7:11, 5:14])


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
def test_gaussian_splat__supports_a_field_of_view_along_any_axis(raw, axis):
    camera = make_sensor_camera()
    W = camera.width
    H = camera.height
    f = camera.K[0, 0]
    extent = {
        "x": W,
        "y": H,
        "diagonal": np.hypot(W, H),
        "smaller": min(W, H),
        "larger": max(W, H),
    }[axis]
    sensor = {"fov_axis": axis, "fov": float(np.rad2deg(2 * np.arctan(0.5 * extent / f)))}
    assert_close(plugin_image(raw, sensor=sensor), plugin_image(raw), atol=tol.IMAGE_ABS)


def test_gaussian_splat__composites_over_the_background(raw):
    image = plugin_image(raw, background={"type": "rgb", "value": [0.2, 0.5, 0.9]})
    expected = rasterize_view(raw, make_sensor_camera(), (0.2, 0.5, 0.9))["color"]
    assert_close(image, to_linear(expected), atol=tol.IMAGE_ABS)


def test_gaussian_splat__composites_over_an_image(raw):
    camera = make_sensor_camera()
    behind = np.random.default_rng(0).uniform(size=(camera.height, camera.width, 3))
    image = plugin_image(raw, background=mi.TensorXf(behind))
    expected = rasterize_view(raw, camera, behind)["color"]
    assert_close(image, to_linear(expected), atol=tol.IMAGE_ABS)


@pytest.mark.parametrize("sample_border", [False, True])
def test_gaussian_splat__reconstruction_filter_weights_the_pixel_centres(raw, sample_border):
    crop = {"crop_offset_x": 4, "crop_offset_y": 5, "crop_width": 10, "crop_height": 8}
    film = {**crop, "rfilter": {"type": "gaussian", "stddev": 0.6}, "sample_border": sample_border}
    image = plugin_image(raw, film)
    full = plugin_image(raw)

    rfilter = mi.load_dict(film["rfilter"])
    b = rfilter.border_size() if sample_border else 0
    samples = full[5 - b : 13 + b, 4 - b : 14 + b]
    taps = np.array([rfilter.eval(mi.Float(d))[0] for d in range(-3, 4)])

    def blur(values):
        for axis in (0, 1):
            values = np.apply_along_axis(lambda line: np.convolve(line, taps, "same"), axis, values)
        return values

    expected = (blur(samples) / blur(np.ones_like(samples)))[b : b + 8, b : b + 10]
    # The border enlarges the view, and with it the region where splats are linearised at their own
    # centre.
    assert_close(image, expected, atol=1e-3 if sample_border else tol.IMAGE_ABS)


@pytest.mark.slow
def test_gaussian_splat__renders_shapes_of_several_degrees_as_one_cloud():
    raw = make_unit_scene(degree=2)
    raw["sh_coeffs"][4:, 1:] = 0
    parts = [
        to_gaussians({k: v[s] for k, v in raw.items()})
        for s in (slice(0, 4), slice(4, 7), slice(7, None))
    ]
    parts[1] = replace(parts[1], sh_coeffs=parts[1].sh_coeffs[:, :1])
    parts[2] = replace(parts[2], sh_coeffs=parts[2].sh_coeffs[:, :4])
    scene = {f"shape{i}": ellipsoids(part) for i, part in enumerate(parts)}
    scene["shape1"]["type"] = "ellipsoidsmesh"
    integrator = {"type": "gaussian_splat", "aovs": AOVS}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": make_sensor_camera().sensor(),
            "integrator": integrator,
            **scene,
        }
    )
    one = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    assert_close(mi.render(scene), mi.render(one), atol=tol.IMAGE_ABS)

    params = mi.traverse(scene)
    expected = mi.traverse(one)
    for p, keys in (
        (params, ["shape0.data", "shape1.data", "shape2.data"]),
        (expected, ["gaussians.data"]),
    ):
        dr.enable_grad([p[key] for key in keys])
    for s, p in ((scene, params), (one, expected)):
        backward(dr.square(mi.render(s, p)[..., :3]))
    gradient = np.concatenate([np.asarray(dr.grad(params[f"shape{i}.data"])) for i in range(3)])
    assert_close(gradient, dr.grad(expected["gaussians.data"]), rtol=tol.GRADIENT_REL)


def test_gaussian_splat__agrees_with_mitsubas_own_integrator():
    """Ray tracing has no low-pass filter, no linearised projection and orders by entry: similar,
    not equal.
    """
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(20, 4))
    sh_coeffs = rng.normal(size=(20, 4, 3)) * 0.4
    gaussians = Gaussians.from_activated(
        rng.uniform(-1, 1, (20, 3)),
        rng.uniform(0.08, 0.2, (20, 3)),
        quats,
        rng.uniform(0.3, 0.8, 20),
        sh_coeffs,
    )
    camera = Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 96, 72)
    shape = {**ellipsoids(gaussians), "extent": 3.5}
    scene = mi.load_dict({"type": "scene", "gaussians": shape, "sensor": camera.sensor()})
    splatted = np.asarray(mi.render(scene, integrator=mi.load_dict({"type": "gaussian_splat"})))
    traced = np.asarray(
        mi.render(scene, integrator=mi.load_dict({"type": "volprim_rf_basic"}), spp=16)
    )
    psnr = -10 * np.log10(np.mean((splatted - traced) ** 2))
    assert psnr > 45  # 51 dB, of which Mitsuba's cut-off at `extent` standard deviations costs one


@pytest.mark.usefixtures("new_attributes")
def test_gaussian_splat__renders_a_new_attribute_of_the_table(raw):
    """Every attribute with a channel is a shape attribute and an AOV."""
    normals = np.float32(np.random.default_rng(6).normal(size=(len(raw["means"]), 3)))
    gaussians = ExtendedGaussians(**raw, logit_roughness=raw["logit_confidence"], normals=normals)
    scene = make_mitsuba_scene(gaussians, aovs="roughness,confidence,normal")
    assert scene.integrator().aov_names() == [
        "roughness.Y",
        "confidence.Y",
        "normal.X",
        "normal.Y",
        "normal.Z",
    ]
    image = np.asarray(mi.render(scene))
    assert np.abs(image[..., 3]).max() > 0
    assert_close(image[..., 3], image[..., 4])
    assert_close(
        image[..., 5:],
        rasterize(gaussians, make_sensor_camera(), ("normal",))["normal"],
        atol=tol.IMAGE_ABS,
    )
    integrator = mi.load_dict({"type": "gaussian_splat", "aovs": "roughness"})
    bare = make_mitsuba_scene(to_gaussians(raw))
    with pytest.raises(ValueError, match=r"must have `roughness` \[N, 1\] with N=10, got only"):
        integrator.render(bare)
