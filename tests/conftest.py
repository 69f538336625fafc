"""One variant for all tests; its kernels are shared."""

from __future__ import annotations

import mitsuba as mi
import pytest

import morgs_mi  # noqa: F401  (finds a usable LLVM before the variant is set)

mi.set_variant("llvm_ad_rgb")


@pytest.fixture(autouse=True)
def llvm_variant():
    """Leave every test with the variant it started from."""
    mi.set_variant("llvm_ad_rgb")
    yield
    mi.set_variant("llvm_ad_rgb")
