"""Registry of implementations; a setting selects one by a string: NAME or NAME:ARGUMENT."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Generic, TypeVar

from morgs_mi.platform.extras import extra_function, places

Made = TypeVar("Made")
Config = TypeVar("Config")


class Registry(Generic[Made, Config]):
    """Factories by name.

    A factory takes the argument of the string (empty for a NAME alone) and a config, and returns
    the implementation.

    Args:
        place: the class with the setting, for error messages.
        setting: the setting that holds the string, for error messages.
        config: class of the config, which `make` builds where it gets none.
    """

    def __init__(self, place: str, setting: str, config: Callable[[], Config]) -> None:
        self._place = place
        self._setting = setting
        self._config = config
        self._entries: dict[str, tuple[str, Callable[[str, Config], Made]]] = {}
        # The last few implementations: a network is loaded once.
        self._make = lru_cache(maxsize=8)(
            lambda name, argument, config: self._entries[name][1](argument, config)
        )

    def register(
        self, name: str, argument: str = ""
    ) -> Callable[[Callable[[str, Config], Made]], Callable[[str, Config], Made]]:
        """Return a decorator that registers a factory.

        Args:
            name: the name that selects it.
            argument: placeholder of the argument in messages, e.g. ``FOLDER``; empty: the name
                takes no argument.

        Raises:
            ValueError: the name is empty, has a colon or is taken.
        """
        if not name or ":" in name or name in self._entries:
            problem = "is registered already" if name in self._entries else "is no name"
            raise ValueError(
                f"register(): `name` must be a new name without a colon, got {name!r}, which "
                f"{problem}; rename one."
            )

        def add(factory: Callable[[str, Config], Made]) -> Callable[[str, Config], Made]:
            self._entries[name] = argument, factory
            return factory

        return add

    def fill(self, package: str, path: Iterable[str], extras: str) -> None:
        """Import the modules of a package, which register themselves, and register what extras add.

        Args:
            package: its name.
            path: its folders.
            extras: kind of these entries of extras.
        """
        for module in iter_modules(path):
            import_module(f"{package}.{module.name}")
        for name in places(extras):
            self.register(*name.split(":"))(extra_function(extras, name))

    @property
    def usages(self) -> tuple[str, ...]:
        """Values of the setting: names without an argument, then NAME:ARGUMENT of the others."""
        entries = sorted(self._entries.items(), key=lambda entry: bool(entry[1][0]))
        return tuple(f"{name}:{text}" if text else name for name, (text, _) in entries)

    def make(self, text: str, config: Config | None = None) -> Made:
        """Return the implementation that `text` selects; None: with the defaults.

        Raises:
            ValueError: `text` selects none, or as its factory.
        """
        self.check(text)
        name, _, argument = text.partition(":")
        return self._make(name, argument, self._config() if config is None else config)

    def check(self, text: str) -> None:
        """Raise an error unless `text` selects an implementation, which is not made.

        Raises:
            ValueError: it selects none.
        """
        name, colon, argument = text.partition(":")
        placeholder, _ = self._entries.get(name, (None, None))
        if placeholder is None or not (bool(placeholder) == bool(colon) == bool(argument)):
            usages = ", ".join(self.usages) or "the registered names, of which there are none"
            raise ValueError(
                f"{self._place}: `{self._setting}` must be one of {usages}, got {text!r}."
            )
