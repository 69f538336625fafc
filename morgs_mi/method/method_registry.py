"""Registry of implementations; a setting selects one by a string: NAME or NAME:ARGUMENT."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Generic, TypeVar

Made = TypeVar("Made")
Config = TypeVar("Config")


class Registry(Generic[Made, Config]):
    """Factories by name.

    A factory takes the argument of the string (empty for a NAME alone) and a config, and returns
    the implementation.

    Args:
        place: the public function that looks names up, for error messages.
        setting: the setting that holds the string, for error messages.
    """

    def __init__(self, place: str, setting: str) -> None:
        self._place = place
        self._setting = setting
        self._factories: dict[str, Callable[[str, Config], Made]] = {}
        self._arguments: dict[str, str] = {}
        self._cached = lru_cache(maxsize=8)(self._make)

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
        if not name or ":" in name or name in self._factories:
            raise ValueError(
                f"register(): `name` must be a new name without a colon, got {name!r}; rename one."
            )

        def add(factory: Callable[[str, Config], Made]) -> Callable[[str, Config], Made]:
            self._factories[name] = factory
            self._arguments[name] = argument
            return factory

        return add

    @property
    def usages(self) -> tuple[str, ...]:
        """Values of the setting: names without an argument, then NAME:ARGUMENT of the others."""
        usages = [f"{name}:{argument}" for name, argument in self._arguments.items()]
        return tuple(
            usage.removesuffix(":") for usage in sorted(usages, key=lambda usage: usage[-1] != ":")
        )

    def make(self, text: str, config: Config) -> Made:
        """Return the implementation that `text` selects; the last few are cached, so a network is
        loaded once.

        Raises:
            ValueError: `text` selects none, or as its factory.
        """
        self.check(text)
        return self._cached(text, config)

    def _make(self, text: str, config: Config) -> Made:
        name, _, argument = text.partition(":")
        return self._factories[name](argument, config)

    def check(self, text: str, place: str = "") -> None:
        """Raise an error unless `text` selects an implementation, which is not made.

        Args:
            text: value of the setting.
            place: where the error's sentence begins; by default the function that looks names up.

        Raises:
            ValueError: it selects none.
        """
        name, colon, argument = text.partition(":")
        takes_argument = bool(self._arguments.get(name))
        if name not in self._factories or not (takes_argument == bool(colon) == bool(argument)):
            usages = ", ".join(self.usages) or "the registered names, of which there are none"
            raise ValueError(
                f"{place or self._place}: `{self._setting}` must be one of {usages}, got {text!r}."
            )
