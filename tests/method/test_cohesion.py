"""Cohesion: an object moves as a whole, and a patch of a large static surface does not."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.method.cohesion import NEIGHBOURS, NeighbourIndex, share_confidence
from tests.scenes.gaussians import isotropic, random_sheet

STILL = -2.0
# The wall has 600 Gaussians, the object 100.
WALL = np.arange(700) < 600


def wall_and_object(height):
    """Return Gaussians of a wall, and of a patch at some height above it."""
    rng = np.random.default_rng(0)
    means = np.concatenate([random_sheet(rng, 600, 1.0, 0.0), random_sheet(rng, 100, 0.3, height)])
    return isotropic(means, 0.05, 0.9)


def moving(share, seed=1):
    """Return logits of 700 Gaussians: a share of the object's moves for sure, and everything else
    stands still.
    """
    rng = np.random.default_rng(seed)
    return np.where(~WALL & (rng.random(700) < share), 2.0, STILL).astype(np.float32)


def shared(gaussians, logit, indices=None):
    indices = np.arange(len(gaussians)) if indices is None else indices
    neighbours = NeighbourIndex(np.asarray(gaussians.means))
    return share_confidence(gaussians, indices, logit, STILL, neighbours)


def test_share_confidence__fills_gaps_in_an_object_apart_from_others():
    confidence = shared(wall_and_object(1.0), moving(0.7))
    assert (confidence[~WALL] > 0).all()
    assert (confidence[WALL] < -1).all()


def test_share_confidence__rejects_evidence_on_a_part_of_a_static_surface():
    """A shadow on the wall: its Gaussians are the patch's."""
    confidence = shared(wall_and_object(0.0), moving(0.7))
    assert (confidence < 0).mean() > 0.98


def test_share_confidence__solves_its_equation(monkeypatch):
    gaussians = wall_and_object(0.3)
    monkeypatch.setattr("morgs_mi.method.cohesion.WEIGHT", 0.2)
    few = shared(gaussians, moving(0.5))
    monkeypatch.setattr("morgs_mi.method.cohesion.ROUNDS", 151)
    many = shared(gaussians, moving(0.5))
    assert_allclose(few, many, atol=1e-5)
    means = np.asarray(gaussians.means)
    i = 650
    near = np.argsort(np.linalg.norm(means - means[i], axis=1))[1 : NEIGHBOURS + 1]
    affinity = 0.2 * 0.9  # of an opaque neighbour
    expected = (moving(0.5)[i] + affinity * many[near].sum()) / (1 + affinity * len(near))
    assert_allclose(many[i], expected, atol=1e-4)


def test_share_confidence__counts_all_but_the_chosen_as_still():
    gaussians = wall_and_object(0.0)
    indices = np.flatnonzero(~WALL)
    confidence = shared(gaussians, np.full(100, 2.0, np.float32), indices=indices)
    assert confidence.shape == (100,)
    assert (confidence < 0).all()


def test_share_confidence__returns_the_logits_without_neighbours_or_weight(monkeypatch):
    one = isotropic(np.zeros((1, 3)), 0.1, 0.9)
    logit = np.array([1.5], np.float32)
    assert_array_equal(shared(one, logit), logit)
    monkeypatch.setattr("morgs_mi.method.cohesion.WEIGHT", 0)
    assert_array_equal(shared(wall_and_object(0.0), moving(0.5)), moving(0.5))
