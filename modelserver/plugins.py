"""Named objects of this package and of installed packages, which add theirs by entry points; objects loaded late."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

T = TypeVar("T")


class PluginRegistry(Mapping[str, T]):
    """Objects by name: those of this package, and those of installed packages.

    A package adds one with an entry point of a group, whose name is that of the object. The entry points are read when
    a name is not one of this package's own. `problems` are those that cannot be used, by name; they do not affect the
    others.
    """

    def __init__(
        self,
        group: str,
        find_fault: Callable[[str, Any], str],
        own: Mapping[str, T] | None = None,
        find_entry_points: Callable[[], Iterable[Any]] | None = None,
    ):
        """Make a registry of an entry point `group`.

        `find_fault` returns why the object of a name cannot be used; empty if it can.
        """
        self._group = group
        self._find_fault = find_fault
        self._own = dict(own or {})
        self._find_entry_points = find_entry_points or self._find_installed
        self._all: Mapping[str, T] | None = None
        self._problems: dict[str, str] = {}

    def __getitem__(self, name: str) -> T:
        return self._own[name] if name in self._own else self._load()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._load())

    def __len__(self) -> int:
        return len(self._load())

    @property
    def plugins(self) -> Mapping[str, T]:
        """The objects of installed packages."""
        return {name: found for name, found in self._load().items() if name not in self._own}

    @property
    def problems(self) -> Mapping[str, str]:
        """Why entry points cannot be used, by name."""
        self._load()
        return self._problems

    def add(self, name: str, given: T) -> None:
        """Add an object of this process, as an installed package would. Raises ValueError if it cannot be used."""
        if fault := self._find_fault(name, given):
            raise ValueError(fault)
        self._own[name] = given
        self._all = None

    def _load(self) -> Mapping[str, T]:
        if self._all is None:
            found = dict(self._own)
            for entry in self._find_entry_points():
                try:
                    loaded = entry.load()
                except Exception as error:
                    self._problems[entry.name] = f"{type(error).__name__}: {error}"
                    continue
                if fault := self._find_fault(entry.name, loaded):
                    self._problems[entry.name] = f"{entry.value} {fault}"
                elif entry.name in found:
                    self._problems[entry.name] = "there is one of that name already"
                else:
                    found[entry.name] = loaded
            self._all = found
        return self._all

    def _find_installed(self) -> Iterable[Any]:
        from importlib.metadata import entry_points

        return entry_points(group=self._group)


def load_object(module: str, name: str) -> Any:
    """Return an object of a module that is imported now, so that what needs it only on request does not load it."""
    from importlib import import_module

    return getattr(import_module(module), name)
