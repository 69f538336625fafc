"""OpenUSD: attributes are read back frame by frame, births and deaths, and OpenUSD's own
validation.
"""

import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.cli.main import main
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.geometry import covariances, rotated, unit_quats
from morgs_mi.extras.exports.gltf_export import gltf_axes
from morgs_mi.extras.exports.usd import write_usd
from morgs_mi.playback.export.formats import USD
from morgs_mi.testing import assert_close
from tests.scenes.changing_splats import rig, splats, write_stream
from tests.scenes.full_disk import files_end_at

Usd = pytest.importorskip("pxr.Usd")
UsdGeom = pytest.importorskip("pxr.UsdGeom")
UsdValidation = pytest.importorskip("pxr.UsdValidation")
UsdVol = pytest.importorskip("pxr.UsdVol")

SH = "radiance:sphericalHarmonicsCoefficients"
FRAMES = range(4)


def written(path, states=4, **options):
    """Write a stream with births and deaths and its stage, and return its states and the stage."""
    coded = write_stream(path.with_name("s.morgs"), states)
    write_usd(StreamReader(path.with_name("s.morgs")), path, range(states), **options)
    return coded, Usd.Stage.Open(str(path))


def values(prim, time, half=False):
    """Return the attributes of a prim at a time by their names as floats; quaternions are wxyz."""
    arrays = {}
    for name in ("positions", "orientations", "scales", "opacities", SH):
        suffix = "h" if half and name != "positions" else ""
        value = prim.GetAttribute(name + suffix).Get(time)
        if name == "orientations":
            value = [[q.GetReal(), *q.GetImaginary()] for q in value]
        arrays[name] = np.array(value, np.float64)
    return arrays


def expected(gaussians):
    raw = gaussians.numpy()
    return {
        "positions": raw["means"],
        "orientations": unit_quats(gaussians),
        "scales": np.exp(raw["log_scales"]),
        "opacities": 1 / (1 + np.exp(-raw["logit_opacities"])),
        SH: raw["sh_coeffs"],
    }


def test_write_usd__describes_the_stage_with_the_origin_of_the_header(tmp_path):
    origin = [500000.0, 5300000.0, 120.0]
    write_stream(tmp_path / "s.morgs", 4, metadata={"origin": origin})
    write_usd(StreamReader(tmp_path / "s.morgs"), tmp_path / "a.usda", FRAMES)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    assert prim.GetPath() == "/Stream"
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (10, 10)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 3)
    back = np.array(prim.GetCustomDataByKey("world_from_usd"))
    assert_close(gltf_axes(rig()).T @ back, np.eye(3), atol=1e-12)
    (place,) = UsdGeom.Xformable(prim).GetOrderedXformOps()
    assert_close(np.array(place.Get()) @ back, origin, atol=1e-6)


@pytest.mark.parametrize("suffix", [f".{usd.name}" for usd in USD])
def test_write_usd__attributes_are_read_back(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr("morgs_mi.extras.exports.usd.UNSAVED_BYTES", 100)
    states, stage = written(tmp_path / f"a{suffix}")
    prim = stage.GetPrimAtPath("/Stream/Gaussians")
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 1
    assert prim.GetAttribute("sortingModeHint").Get() == "zDepth"
    for state in states:
        arrays = values(prim, state.frame)
        alive = np.isin(np.arange(42), state.ids)
        assert [len(array) for array in arrays.values()] == [42, 42, 42, 42, 4 * 42]
        arrays[SH] = arrays[SH].reshape(42, 4, 3)
        gaussians = rotated(state.gaussians, gltf_axes(rig()))
        for name, value in expected(gaussians).items():
            assert_close(arrays[name][alive], value, rtol=1e-6, atol=1e-6)
        assert_array_equal(arrays["opacities"][~alive], 0)
        means = gaussians.numpy()["means"]
        reach = 3 * np.sqrt(np.diagonal(covariances(gaussians), axis1=1, axis2=2))
        extent = np.array([(means - reach).min(axis=0), (means + reach).max(axis=0)])
        assert_close(np.array(prim.GetAttribute("extent").Get(state.frame)), extent, atol=1e-5)


@pytest.mark.parametrize("suffix", [f".{usd.name}" for usd in USD])
@pytest.mark.parametrize("half", [False, True])
def test_write_usd__passes_the_validators_of_openusd(tmp_path, suffix, half):
    _, stage = written(tmp_path / f"a{suffix}", half=half)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    stage.ClearMetadata("upAxis")
    assert UsdValidation.ValidationContext(validators).Validate(stage)
    # The values have the types of the schema, and nothing else is written.
    definition = Usd.SchemaRegistry().FindConcretePrimDefinition("ParticleField3DGaussianSplat")
    for attribute in stage.GetPrimAtPath("/Stream/Gaussians").GetAuthoredAttributes():
        assert (
            definition.GetAttributeDefinition(attribute.GetName()).GetTypeName()
            == attribute.GetTypeName()
        )


def test_write_usd__interpolates_the_same_gaussians_between_frames(tmp_path):
    """In frame 2 one dies and two are born. What does not change has no further samples."""
    states, stage = written(tmp_path / "a.usdc")
    prim = stage.GetPrimAtPath("/Stream/Gaussians")
    middle, left, right = (values(prim, time) for time in (1.5, 1, 2))
    survivors = np.isin(np.arange(42), np.intersect1d(states[1].ids, states[2].ids))
    for name in ("positions", "opacities"):
        assert_close(middle[name], (left[name] + right[name]) / 2, atol=1e-6)
    motion = right["positions"] - left["positions"]
    assert np.abs(motion[survivors]).max() > 0.09
    # Births and deaths stay in their places and fade.
    assert_close(motion[~survivors], 0)
    assert left["opacities"][0] > 0
    assert right["opacities"][0] == 0
    assert prim.GetAttribute("positions").GetTimeSamples() == [0, 1, 2, 3]
    assert prim.GetAttribute("scales").GetTimeSamples() == [0]
    # A value that stays is held up to the last frame before it changes.
    assert prim.GetAttribute("opacities").GetTimeSamples() == [0, 1, 2]


def test_write_usd__half_precision_is_about_half_as_large(tmp_path):
    write_stream(tmp_path / "s.morgs", 1, splats(2000, 3))
    for name, half in (("full.usdc", False), ("half.usdc", True)):
        write_usd(StreamReader(tmp_path / "s.morgs"), tmp_path / name, [0], half)
    stages = [Usd.Stage.Open(str(tmp_path / name)) for name in ("full.usdc", "half.usdc")]
    prims = [stage.GetPrimAtPath("/Stream/Gaussians") for stage in stages]
    full = values(prims[0], 0)
    half = values(prims[1], 0, half=True)
    assert_close(half["positions"], full["positions"])
    for name, value in full.items():
        assert_close(half[name], value, rtol=2**-11, atol=1e-4)
    assert (tmp_path / "half.usdc").stat().st_size < 0.6 * (tmp_path / "full.usdc").stat().st_size


def test_write_usd__begins_a_prim_for_a_new_set_of_gaussians(tmp_path):
    with StreamWriter(tmp_path / "s.morgs", rig(), 10) as writer:
        for t, (count, degree) in enumerate(((5, 0), (7, 1), (0, 1), (3, 2))):
            writer.write(keyframe_packet(splats(count, degree), t, rig()))
    write_usd(StreamReader(tmp_path / "s.morgs"), tmp_path / "a.usdc", FRAMES)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    prims = stage.GetDefaultPrim().GetChildren()
    assert [prim.GetName() for prim in prims] == [
        "Gaussians",
        *(f"Gaussians{k}" for k in (1, 2, 3)),
    ]
    visible = [[UsdGeom.Imageable(p).ComputeVisibility(t) for t in FRAMES] for p in prims]
    assert_array_equal(np.array(visible) == "inherited", np.eye(4, dtype=bool))
    degrees = [prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() for prim in prims]
    assert degrees == [0, 1, 1, 2]
    assert [len(prim.GetAttribute("positions").Get(0) or ()) for prim in prims] == [5, 7, 0, 3]


def test_export_usd__writes_selected_frames(tmp_path, capsys):
    write_stream(tmp_path / "stream.morgs")
    assert main(["export", "usd", str(tmp_path), str(tmp_path / "a.usda"), "--frames", "1:3"]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path}/a.usda: 2 frames, ")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 2)
    assert main(["export", "usd", str(tmp_path)]) == 0
    assert (tmp_path / "stream.usdc").is_file()


@pytest.mark.parametrize("suffix", [f".{usd.name}" for usd in USD])
def test_export_usd__removes_its_output_on_a_full_disk(tmp_path, capfd, suffix):
    write_stream(tmp_path / "stream.morgs")
    with files_end_at(3000):
        status = main(["export", "usd", str(tmp_path), str(tmp_path / f"a{suffix}")])
    error = capfd.readouterr().err
    assert status == 1
    assert f"a{suffix}: Error occurred writing file: File too large; check" in error
    assert [path.name for path in tmp_path.iterdir()] == ["stream.morgs"]


def test_write_usd__names_the_missing_package(tmp_path, monkeypatch):
    write_stream(tmp_path / "s.morgs", 1)
    monkeypatch.setitem(sys.modules, "pxr.UsdVol", None)
    with pytest.raises(
        ValueError, match=r"expected the package usd-core, found none; .* 'morgs-mi\[usd\]'"
    ):
        write_usd(StreamReader(tmp_path / "s.morgs"), tmp_path / "a.usdc", [0])
    assert len(list(tmp_path.iterdir())) == 1
