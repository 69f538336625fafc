"""What extras add to the registries of the package.

An extra is a folder of `morgs_mi.extras`, or an entry point of the group `morgs_mi.extras` in
another package. Its function `register` enters places by name; what lies there is imported when it
is used. Only the list of public names has names of extras, so each folder can be deleted.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import iter_modules, resolve_name
from typing import Any

_LOG = logging.getLogger(__name__)
_PLACES: dict[str, dict[str, str]] = {}


def enter(package: str, registry: str, entries: Mapping[str, str]) -> None:
    """Add entries of an extra to a registry.

    Args:
        package: of the extra, its `__name__`.
        registry: "commands", "exports", "integrators", "layouts", "cameras", "flow sources" or
            "mask refiners".
        entries: MODULE or MODULE:NAME inside the package, by the name of the entry. A command
            replaces the package's of the same name, which it extends. A source of flow or a
            refiner of masks may have an argument, as in ``onnx:FILE``.
    """
    full_places = {name: f"{package}.{place}" for name, place in entries.items()}
    _PLACES.setdefault(registry, {}).update(full_places)


def places(registry: str) -> Mapping[str, str]:
    """Return the places that extras have entered into a registry, by name."""
    _register()
    return _PLACES.get(registry, {})


def extra(registry: str, name: str) -> Any:
    """Return the class, function or module that an extra has entered into a registry.

    Raises:
        ValueError: none has.
    """
    place = places(registry).get(name)
    if place is None:
        raise ValueError(
            f"{registry}: expected an extra that adds {name}, found none; install morgs_mi with "
            "all folders of extras."
        )
    return resolve_name(place)


def extra_function(registry: str, name: str) -> Callable[..., Any]:
    """Return the function of an entry, which is imported when it is called."""
    return lambda *arguments: extra(registry, name)(*arguments)


@cache
def _register() -> None:
    """Let all extras enter their places, once."""
    folder = Path(__file__).parents[1] / "extras"
    for module in iter_modules([str(folder)]):
        import_module(f"morgs_mi.extras.{module.name}").register()
    for point in entry_points(group="morgs_mi.extras"):
        try:
            point.load()()
        except Exception as error:
            _LOG.warning("%s: this extra is left out, it cannot register (%s).", point.value, error)
