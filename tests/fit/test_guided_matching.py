"""Matching with known poses."""

from dataclasses import replace

from morgs_mi.fit.features import SharedFeatures
from morgs_mi.fit.guided_matching import match_guided
from tests.scenes.textured import turned


def test_match_guided__finds_true_matches_alone(textured_capture, textured_features):
    """Next to none with wrong poses, or of patches of another size or orientation."""
    features = textured_features.features
    cameras = textured_capture.cameras
    (match,) = match_guided(textured_features, cameras, [(0, 4)])
    assert match.views == (0, 4)
    assert len(match.features) > 100
    assert textured_features.reprojection_errors(match, cameras).max() < 1
    assert match_guided(textured_features, [cameras[0]] * 6, [(0, 4)]) == []

    def with_axes(axes):
        turned_patches = replace(features[4], axes=axes)
        return SharedFeatures((*features[:4], turned_patches, *features[5:]), ())

    for wrong_features, view in (
        (textured_features, turned(cameras[4], 90)),
        (with_axes(2 * features[4].axes), cameras[4]),
        (with_axes(features[4].axes[:, ::-1] * (-1, 1)), cameras[4]),
    ):
        matches = match_guided(wrong_features, [*cameras[:4], view, *cameras[5:]], [(0, 4)])
        assert sum(len(m.features) for m in matches) < 0.05 * len(match.features)
