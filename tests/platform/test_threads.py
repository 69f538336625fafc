"""Work in threads."""

import pytest

from morgs_mi.platform.threads import map_in_threads


def test_map_in_threads__keeps_the_order_and_raises_what_the_function_raises():
    assert map_in_threads(lambda x: x * x, range(50)) == [x * x for x in range(50)]
    with pytest.raises(ZeroDivisionError):
        map_in_threads(lambda x: 1 // x, [1, 0])
