"""Cells that are computed by this process or by workers."""

from __future__ import annotations

import logging
from contextlib import nullcontext

import pytest

from benchmarks.reports.cells import run_cells
from tests.benchmarks.reports.here import client_here


def square(number: int) -> int:
    if number < 0:
        raise ValueError(f"{number}: expected a positive number.")
    logging.getLogger("morgs_mi").warning("squared")
    return number * number


@pytest.mark.parametrize("opened", [nullcontext, client_here])
def test_run_cells__returns_the_results_in_order_with_their_warnings(
    opened, caplog: pytest.LogCaptureFixture
):
    arrived = []
    with opened() as client:
        results = run_cells(
            square, {"b": (2,), "a": (1,)}, client, lambda *each: arrived.append(each)
        )
    assert list(results.items()) == sorted(arrived, reverse=True) == [("b", 4), ("a", 1)]
    assert "squared" in caplog.messages


@pytest.mark.parametrize("opened", [nullcontext, client_here])
def test_run_cells__raises_the_error_of_a_cell(opened):
    with opened() as client, pytest.raises(ValueError, match="-1: expected a positive number"):
        run_cells(square, {"a": (-1,)}, client, lambda *_: None)
