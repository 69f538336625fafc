"""Every table of docs/experiments, by the name that a page gives it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from benchmarks.pages import captures, method, system

__all__ = ["TABLES"]

TABLES: Mapping[str, Callable[[], str]] = {
    name: getattr(module, name) for module in (method, captures, system) for name in module.__all__
}
