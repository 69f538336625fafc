"""Problems of images: of one colour, and cuts; motion, noise, light and exposure are none."""

from itertools import zip_longest

import numpy as np
import pytest

from morgs_mi.core.camera import Camera
from morgs_mi.loop.input_images import image_status
from morgs_mi.loop.seen_view import SeenView, ViewHistory
from morgs_mi.method.exposure import Exposure

H = 48
W = 64
NAMES = ("a", "b", "c")


def scene(seed):
    """A picture of coarse structure, uint8 [H, W, 3]."""
    coarse = np.random.default_rng(seed).integers(20, 220, (6, 8, 3))
    return np.uint8(np.repeat(np.repeat(coarse, 8, 0), 8, 1))


def noisy(image, sigma, seed=0):
    return np.uint8(
        np.clip(image + np.random.default_rng(seed).normal(0, sigma, image.shape), 0, 255)
    )


RIG = (scene(0), scene(1), scene(2))


def status(images, previous=()):
    """Return the status of images, and of those of the frame before, by view."""
    views = []
    for index, (image, last) in enumerate(zip_longest(images, previous)):
        if image is None:
            continue
        camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 50, W, H, NAMES[index])
        views.append(
            SeenView(
                camera,
                image,
                index=index,
                recorded=image,
                previous=last,
                change=np.zeros((H, W), bool),
                history=ViewHistory(image, image, Exposure()),
            )
        )
    return image_status(views)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((H, W, 3), np.uint8), "b: the image is black; "),
        (noisy(np.zeros((H, W, 3)), 4), "b: the image is black; "),
        (np.full((H, W, 3), 255, np.uint8), "b: the image is of one colour; "),
        (np.full((H, W, 3), (200, 30, 30), np.uint8), "b: the image is of one colour; "),
    ],
)
def test_image_status__names_views_of_one_colour(image, words):
    for previous in ((), RIG):
        (problem,) = status((RIG[0], image, RIG[2]), previous)
        assert problem.startswith(words)
        assert "--exclude" in problem


def test_image_status__names_a_cut_of_all_views_or_of_one():
    (problem,) = status((scene(3), scene(4), scene(5)), RIG)
    assert problem.startswith(
        "the images show another scene than in the frame before; end the fit before this frame"
    )
    (problem,) = status((*RIG[:2], scene(6)), RIG)
    assert problem.startswith("c: the image shows something else than in the frame before")


def with_object(column):
    """A dull wall with a bright object."""
    image = noisy(np.full((H, W, 3), 100.0), 5)
    image[10:34, column : column + 16] = (255, 240, 200)
    return image


@pytest.mark.parametrize(
    ("previous", "current"),
    [
        (scene(0), scene(0)),
        (scene(0), noisy(scene(0), 12)),
        (scene(0), np.uint8(scene(0) * 0.5)),  # the light goes out
        (np.uint8(scene(0) * 0.4), np.uint8(scene(0) * 0.4 + 100)),
        (with_object(0), with_object(40)),
        (np.zeros((H, W, 3), np.uint8), scene(0)),
    ],
)
def test_image_status__is_empty_for_motion_noise_and_light(previous, current):
    assert status(3 * [current], 3 * [previous]) == ()


def test_image_status__compares_views_that_have_both_images():
    assert status((None, RIG[1]), RIG[:1]) == ()
    assert status(()) == ()
