from itertools import product

from morgs_mi.core.random_streams import Stream, rng_of


def test_rng_of__streams_never_collide():
    keys = list(product(range(3), Stream, range(15)))
    first = [tuple(rng_of(*key).integers(0, 2**63, 2).tolist()) for key in keys]
    assert len(set(first)) == len(keys)
