"""Program that adds an attribute to the table and streams it; `test_quantisation` runs it in a
process of its own.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

import morgs_mi  # noqa: F401  (finds a usable LLVM before the variant is set)
from morgs_mi.core import attributes, gaussians

ROW = attributes.Attribute("logit_labels", (2,), "labels", attributes.SIGMOID, error=0.01)


@dataclass(frozen=True)
class LabelledGaussians(gaussians.Gaussians):
    """Gaussians with the field of the new row."""

    logit_labels: Any = None


def add_row():
    """Add the row and the field, and forget the modules that were imported without them."""
    attributes.ATTRIBUTES = gaussians.ATTRIBUTES = (*attributes.ATTRIBUTES, ROW)
    attributes.BY_NAME[ROW.name] = attributes.BY_ACTIVATED_NAME[ROW.activated_name] = ROW
    gaussians.Gaussians = LabelledGaussians
    for name in [name for name in sys.modules if name.startswith("morgs_mi.codec")]:
        del sys.modules[name]


def check_round_trip(confidence):
    """Check the decoded attributes of labelled Gaussians of which some change, die and are born."""
    from morgs_mi.codec.packets import decode, keyframe_packet, reemitted_keyframe, residual_packet
    from tests.scenes.coded_clip import CAMERAS, cloud, jittered

    rng = np.random.default_rng(0)

    def labelled(base):
        return LabelledGaussians(**base.items(), logit_labels=rng.normal(0, 1, (len(base), 2)))

    def error(value, true):
        return float(np.abs(np.asarray(value.labels) - np.asarray(true.labels)).max())

    first = labelled(cloud(50, confidence=confidence))
    state = decode(None, keyframe_packet(first, 0, CAMERAS))
    assert error(state.gaussians, first) <= 0.01 / 4, "of four times the precision at birth"
    assert np.array_equal(decode(None, reemitted_keyframe(state)).digest, state.digest)

    alive = np.arange(2, 50)
    relabelled = rng.random(48) < 0.5
    survivors = jittered(state.gaussians, rng).select(alive)
    labels = state.gaussians.numpy()[ROW.name][alive] + 0.5 * relabelled[:, None]
    births = labelled(cloud(3, confidence=confidence, seed=2))
    target = gaussians.Gaussians.concatenate([replace(survivors, logit_labels=labels), births])
    new_state = decode(state, residual_packet(state, target, np.r_[alive, -1, -1, -1], CAMERAS))
    assert new_state.ids.tolist() == list(range(2, 53))
    columns = state.grid.columns[ROW.name]
    changes = new_state.grid.values[:48, columns] != state.grid.values[alive, columns]
    assert np.array_equal(changes.any(1), relabelled)
    assert error(new_state.gaussians, target) <= 0.02
    assert (new_state.gaussians.logit_confidence is None) == (not confidence)


def main():
    """Check the new row and print the digest of a stream without labels."""
    mi.set_variant("llvm_ad_rgb")
    add_row()
    from tests.scenes.coded_clip import encoded_clip, history

    for confidence in (False, True):
        check_round_trip(confidence)
    print(history(encoded_clip(4)[1]))


if __name__ == "__main__":
    main()
