"""Random rooms of the report on starts."""

import mitsuba as mi
import numpy as np

from benchmarks.reports.starts import random_room, traced


def test_random_room__shows_its_person_upright_in_the_middle_of_all_views():
    mi.set_variant("llvm_ad_rgb")
    for view in traced(random_room("room 1")):
        rows, columns = np.nonzero(view.person)
        assert 0.03 < view.person.mean() < 0.1
        assert np.ptp(rows) > np.ptp(columns)
        assert abs(columns.mean() - view.camera.width / 2) < 0.1 * view.camera.width
        assert abs(rows.mean() - view.camera.height / 2) < 0.15 * view.camera.height
