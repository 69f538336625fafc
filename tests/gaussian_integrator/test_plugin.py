"""The plugin `gaussian_splat` in Mitsuba: files, variants, changed scenes, and what it refuses."""

import gc
import re
import textwrap
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import ellipsoids, rasterize
from morgs_mi.io.exr import read_exr
from morgs_mi.io.ply import write_ply
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.gaussian_integrator.expected import to_linear
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import make_unit_scene, to_gaussians
from tests.scenes.plugin import AOVS, make_mitsuba_scene, plugin_image
from tests.scenes.programs import run_script


def test_gaussian_splat__writes_undeveloped_renders(raw, tmp_path):
    """The command `mitsuba scene.xml` requests no tensor and writes the film."""
    scene = make_mitsuba_scene(to_gaussians(raw), aovs=AOVS)
    image = np.asarray(mi.render(scene))
    assert scene.integrator().render(scene, develop=False).shape == (0,)
    path = tmp_path / "image.exr"
    scene.sensors()[0].film().write(str(path))
    assert_array_equal(np.array(mi.Bitmap(str(path)))[..., :3], image[..., :3])


def test_gaussian_splat__reads_props_of_an_xml_scene(raw):
    text = """<integrator version="3.0.0" type="gaussian_splat">
        <string name="aovs" value="depth"/><boolean name="srgb_primitives" value="false"/>
        <rgb name="background" value="0.1, 0.2, 0.3"/>
    </integrator>"""
    integrator = mi.load_string(text)
    assert_allclose(np.array(integrator.background).ravel(), [0.1, 0.2, 0.3], rtol=1e-6)
    image = np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw)), integrator=integrator))
    expected = np.asarray(
        rasterize(to_gaussians(raw), make_sensor_camera(), background=(0.1, 0.2, 0.3)).color
    )
    assert_close(image[..., :3], expected, atol=tol.IMAGE_ABS)


def test_gaussian_splat__ignores_emitters_with_one_warning(raw, caplog):
    shape = ellipsoids(to_gaussians(raw))
    sensor = make_sensor_camera().sensor()
    scene = {
        "type": "scene",
        "gaussians": shape,
        "sensor": sensor,
        "integrator": {"type": "gaussian_splat"},
    }
    dark = mi.load_dict(scene)
    lit = mi.load_dict({**scene, "sky": {"type": "constant"}})
    images = [np.asarray(mi.render(s)) for s in (dark, lit, lit)]
    assert_array_equal(images[0], images[1])
    assert [r.getMessage().split(";")[0] for r in caplog.records] == [
        "gaussian_splat ignores the scene's emitters"
    ]


def test_gaussian_splat__stays_registered_when_variants_are_switched():
    """Importing before any variant is set works; a variant without derivatives is refused in one
    sentence.
    """
    script = r"""
import morgs_mi, mitsuba as mi
for variant in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    integrator = mi.load_dict({"type": "gaussian_splat", "aovs": "depth"})
    if variant != "scalar_rgb":
        print("\n>", variant, integrator.aov_names())
        continue
    try:
        sensor = {"type": "perspective"}
        mi.render(mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor}))
    except ValueError as error:
        print("\n>", error)
"""
    output = run_script(script, check=True).stdout
    assert [line for line in output.splitlines() if line.startswith(">")] == [
        "> gaussian_splat: expected a variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb', got "
        "'scalar_rgb'; call mi.set_variant() before the scene is loaded.",
        "> llvm_ad_rgb ['depth.Y']",
        "> llvm_ad_mono ['depth.Y']",
        "> llvm_ad_rgb ['depth.Y']",
    ]


def test_entry_point__registers_the_integrators_without_the_package():
    """Mitsuba imports the module after the variant is set, and reloads it after each change."""
    script = r"""
import importlib, sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import morgs_mi_plugins
print("\n>", any(name.startswith("morgs_mi.") for name in sys.modules))
for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
    mi.set_variant(variant)
    importlib.reload(morgs_mi_plugins)
    print("\n>", mi.load_dict({"type": "gaussian_splat", "aovs": "depth"}).aov_names())
"""
    lines = run_script(script, check=True).stdout.splitlines()
    shown = [line for line in lines if line.startswith(">")]
    assert shown == ["> False", "> ['depth.Y']", "> []", "> ['depth.Y']"]


def test_gaussian_splat__renders_a_shape_after_density_control(raw):
    """All attributes of a shape may change their length together."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    half = {name: value[:5] for name, value in raw.items()}
    shape = ellipsoids(to_gaussians(half))
    for name in ("data", "opacities", "sh_coeffs", "motion", "confidence"):
        params[f"gaussians.{name}"] = shape[name].array
    params.update()
    expected = to_linear(
        np.asarray(rasterize(to_gaussians(half), make_sensor_camera()).color, np.float64)
    )
    assert_close(mi.render(scene), expected, atol=tol.IMAGE_ABS)


def with_shape(**changes):
    shape = {**ellipsoids(to_gaussians(make_unit_scene())), **changes}
    return {"gaussians": {name: value for name, value in shape.items() if value is not None}}


def ones(*shape):
    return mi.TensorXf(np.ones(shape, np.float32))


BAD_SCENES = {
    "no shape": (
        lambda: {"gaussians": None},
        {},
        "expected a scene with an `ellipsoids` shape, got none",
    ),
    "mesh": (
        lambda: {"wall": {"type": "rectangle"}},
        {},
        "expected `ellipsoids` shapes only, got Rectangle 'wall'",
    ),
    "no opacities": (
        lambda: with_shape(opacities=None),
        {},
        r"'gaussians' must have `opacities` \[N, 1\] with N=10",
    ),
    "odd sh": (lambda: with_shape(sh_coeffs=ones(10, 6)), {}, r"with N=10, got 60 values"),
    "no motion": (
        lambda: with_shape(motion=None),
        {"aovs": "motion"},
        r"`motion` \[N, 3\] with N=10, got only \['.*write_ply\(path, gaussians, "
        r"layout='mitsuba'\)",
    ),
    "thin lens": (
        lambda: {"sensor": {"type": "thinlens", "aperture_radius": 0.1}},
        {},
        "must be a `perspective` sensor, got ThinLens",
    ),
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


def test_gaussian_splat__warns_once_about_opacities_outside_the_unit_interval(caplog):
    opacities = mi.TensorXf(np.float32([-1, 2, -0.1, *[0.5] * 7])[:, None])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": make_sensor_camera().sensor(),
            **with_shape(opacities=opacities),
        }
    )
    integrator = mi.load_dict({"type": "gaussian_splat"})
    for _ in range(2):
        assert np.isfinite(np.array(mi.render(scene, integrator=integrator))).all()
    (record,) = caplog.records
    assert "`opacities` must be in [0, 1], got 3 values outside" in record.message


def test_gaussian_splat__is_refused_under_freeze(raw):
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    opacities = params["gaussians.opacities"] / 2
    dr.eval(opacities)

    @dr.freeze
    def frozen(opacities):
        params["gaussians.opacities"] = opacities
        params.update()
        return mi.render(scene)

    # Dr.Jit ends the process if memory of NumPy that other tests have left is collected in a
    # recording.
    gc.collect()
    gc.disable()
    try:
        with pytest.raises(RuntimeError) as error:
            frozen(opacities)
    finally:
        gc.enable()
    causes = [
        str(error.value.__cause__),
        str(error.value.__cause__ and error.value.__cause__.__cause__),
    ]
    assert any("gaussian_splat: expected a call outside dr.freeze" in cause for cause in causes)


def batch_scene(raw, film, **props):
    """Return a scene of a `batch` of three cameras, and the same sensors, each with a film of its
    own.
    """
    camera = make_sensor_camera()
    sensors = []
    for v in range(3):
        viewmat = np.array(camera.viewmat, np.float64)
        viewmat[0, 3] += 0.1 * v
        sensors.append(replace(camera, viewmat=viewmat, name=f"view{2 - v}").sensor())
    single_sensors = [
        mi.load_dict({**sensor, "film": {**sensor["film"], **film}}) for sensor in sensors
    ]
    inner = {
        f"view{2 - v}": {k: x for k, x in sensor.items() if k != "film"}
        for v, sensor in enumerate(sensors)
    }
    whole = {**sensors[0]["film"], **film, "width": 3 * camera.width}
    scene = {
        "type": "scene",
        "gaussians": ellipsoids(to_gaussians(raw)),
        "sensor": {"type": "batch", **inner, "film": whole},
        "integrator": {"type": "gaussian_splat", "aovs": AOVS, **props},
    }
    return mi.load_dict(scene), single_sensors


def test_gaussian_splat__renders_a_batch_of_sensors_beside_each_other(raw):
    scene, single_sensors = batch_scene(raw, {"pixel_format": "rgba"}, background=[0.1, 0.2, 0.3])
    image = np.array(mi.render(scene))
    expected = np.concatenate(
        [np.array(mi.render(scene, sensor=sensor)) for sensor in single_sensors], axis=1
    )
    assert_array_equal(image, expected)


@pytest.mark.slow
def test_gaussian_splat__differentiates_a_batch_of_sensors(raw):
    scene, single_sensors = batch_scene(raw, {})
    params = mi.traverse(scene)
    data = params["gaussians.data"]
    dr.enable_grad(data)
    backward(dr.square(mi.render(scene, params)))
    gradient = np.array(dr.grad(data))
    dr.set_grad(data, 0)
    for sensor in single_sensors:
        backward(dr.square(mi.render(scene, params, sensor=sensor)))
    assert_close(gradient, np.array(dr.grad(data)), rtol=1e-5)


def test_gaussian_splat__refuses_a_batch_with_a_border(raw):
    scene, _ = batch_scene(raw, {"sample_border": True, "rfilter": {"type": "gaussian"}})
    with pytest.raises(ValueError, match="a film without `sample_border`, got a `batch` of 3"):
        scene.integrator().render(scene)


def test_gaussian_splat__refuses_films_other_than_rgb():
    mi.set_variant("llvm_ad_spectral")
    film = {"type": "specfilm", "band": {"type": "spectrum", "value": [(400, 0.5), (700, 0.5)]}}
    scene = mi.load_dict(
        {"type": "scene", "sensor": {"type": "perspective", "film": film}, **with_shape()}
    )
    with pytest.raises(ValueError, match="expected an `hdrfilm`, got SpecFilm"):
        mi.load_dict({"type": "gaussian_splat"}).render(scene)


@pytest.mark.parametrize(
    ("props", "message"),
    [
        ({"aovs": "normal"}, "`aovs` must be out of depth, motion, confidence, got 'normal'"),
        ({"max_depth": 3}, "unreferenced property"),
        ({"background": "white"}, "`background` must be one or three finite .* got a str"),
        ({"background": {"type": "checkerboard"}}, "`background` must be .* got a Texture"),
        ({"srgb_primitives": "false"}, "`srgb_primitives` must be true or false, got 'false'"),
        ({"surfaces": {"type": "diffuse"}}, "`surfaces` must be an integrator of surfaces"),
        ({"surfaces": {"type": "gaussian_splat"}}, "`surfaces` must be an integrator of surfaces"),
        ({"type": "splat_path", "clipped": "4"}, "`clipped` must be a finite number"),
        ({"type": "splat_path", "max_depth": 3.5}, "`max_depth` must be a whole number"),
        ({"alpha_min": 2.0}, "gaussian_splat: RenderConfig.*`alpha_min` must be below"),
    ],
)
def test_gaussian_splat__refuses_bad_props_when_the_scene_is_loaded(props, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "gaussian_splat", **props})


def test_gaussian_splat__refuses_an_integrator_around_it():
    scene = {"type": "scene", "sensor": make_sensor_camera().sensor(), **with_shape()}
    scene = mi.load_dict(
        {**scene, "integrator": {"type": "moment", "inner": {"type": "gaussian_splat"}}}
    )
    with pytest.raises(RuntimeError) as error:
        mi.render(scene)
    assert "expected to be the scene's integrator, got an integrator around it" in str(
        error.value.__cause__
    )


@pytest.mark.slow
def test_gaussian_splat__names_variants_that_it_does_not_work_in():
    """With `surfaces` it has RGB colours."""
    script = r"""
import morgs_mi, mitsuba as mi
for variant in ("llvm_ad_mono", "llvm_ad_spectral"):
    mi.set_variant(variant)
    for surfaces in ("path", "splat_path"):
        try:
            print("\n>", mi.load_dict({"type": "gaussian_splat", "surfaces": {"type": surfaces}}))
        except RuntimeError as error:
            print("\n>", "expected a variant such as 'llvm_ad_rgb'" in str(error))
"""
    output = run_script(script, check=True).stdout
    assert [line for line in output.splitlines() if line.startswith(">")] == 4 * ["> True"]


def test_gaussian_splat__refuses_an_image_with_surfaces_and_of_another_size(raw):
    image = mi.TensorXf(np.zeros((3, 4, 3)))
    with pytest.raises(RuntimeError, match="must be a colour with `surfaces`, got an image"):
        mi.load_dict({"type": "gaussian_splat", "background": image, "surfaces": {"type": "path"}})
    scene = make_mitsuba_scene(to_gaussians(raw), background=image)
    assert "background = an image [3, 4, 3]," in str(scene.integrator())
    with pytest.raises(ValueError, match=r"`background` must be three .* got float32 \[3, 4, 3\]"):
        scene.integrator().render(scene)


def test_ellipsoids__refuse_no_gaussians(raw):
    with pytest.raises(ValueError, match="at least one Gaussian"):
        ellipsoids(to_gaussians({name: value[:0] for name, value in raw.items()}))


SCENE_FILE = f"""<scene version="3.0.0">
    <integrator type="gaussian_splat"><string name="aovs" value="{AOVS}"/></integrator>
    <shape type="ellipsoids"><string name="filename" value="gaussians.ply"/></shape>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, 0, -3" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <string name="component_format" value="float32"/>
            <integer name="width" value="32"/><integer name="height" value="16"/>
        </film>
    </sensor>
</scene>"""


@pytest.mark.parametrize("shape", ["ellipsoids", "ellipsoidsmesh"])
def test_gaussian_splat__renders_the_same_channels_from_a_file_as_from_a_dictionary(
    tmp_path, raw, shape
):
    expected = plugin_image(raw, aovs=AOVS)
    write_ply(tmp_path / "gaussians.ply", to_gaussians(raw), layout="mitsuba")
    (tmp_path / "scene.xml").write_text(SCENE_FILE.replace("ellipsoids", shape))
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    image = np.asarray(mi.render(scene, sensor=mi.load_dict(make_sensor_camera().sensor())))
    assert image.shape[2] == 3 + 4
    # The last channel is a depth of about 3.
    assert_close(image, expected, atol=tol.IMAGE_ABS, rtol=tol.SUM_ORDER_REL)


@pytest.mark.slow
def test_gaussian_splat__renders_a_scene_file_as_the_page_describes(tmp_path, raw):
    """The command `mitsuba` does not find the plugin; the Python command in docs/mitsuba.md renders
    the same file.
    """
    write_ply(tmp_path / "gaussians.ply", to_gaussians(raw), layout="mitsuba")
    (tmp_path / "scene.xml").write_text(SCENE_FILE)
    page = (Path(__file__).parents[2] / "docs/mitsuba.md").read_text(encoding="utf-8")
    command = textwrap.dedent(re.findall(r"```bash\n(.*?)```", page, re.DOTALL)[0])
    program = re.search(r'python -c "\n(.*?)"', command, re.DOTALL)[1]
    run_script(program, check=True, cwd=tmp_path, timeout=120)
    channels = read_exr(tmp_path / "image.exr")
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    expected = np.array(mi.render(scene))
    assert expected[..., :3].max() > 0.1
    names = ["R", "G", "B", *scene.integrator().aov_names()]
    assert channels.keys() == set(names)
    assert_close(np.stack([channels[name] for name in names], 2), expected, atol=1e-6)
