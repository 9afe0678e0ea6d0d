"""Paths in a frame tree: which frame a `Parent` of Miro's frame store names.

A path is names between slashes, from a frame down to one that it carries: `PanTiltUnit/Pan`. `...` stands for any
number of levels, `A/.../B`; `.` for none; `..` takes the name before it back. A path that begins with a slash begins at
a root; any other may begin anywhere, so `Pan` is `.../Pan`, and a root goes before a frame further down. NASA's frame
store has the same rules, but there a parent must stand before its children; here the order of the file is free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

ANY = "..."

GREATEST_STEPS = 2_000_000
"""Levels that are walked for all paths of a file: only a file made to take time needs more."""


@dataclass(frozen=True, slots=True)
class FramePath:
    """A path: its names from above to below, and whether it begins at a root."""

    parts: tuple[str, ...]
    is_absolute: bool

    @property
    def name(self) -> str:
        """The frame that the path names, without the way to it."""
        return self.parts[-1] if self.parts else ""

    @property
    def is_plain(self) -> bool:
        """Whether it is a name alone, which any frame of that name fits."""
        return len(self.parts) == 1 and not self.is_absolute

    def matches(self, names: Sequence[str]) -> bool:
        """Return whether the frame with these names, from the root down to its own, is one that the path names."""
        if ANY not in self.parts:
            above = len(names) - len(self.parts)
            return above >= 0 and (not self.is_absolute or above == 0) and tuple(names[above:]) == self.parts
        parts = self.parts if self.is_absolute else (ANY, *self.parts)
        # as a star in a file name: on a mismatch the last wildcard takes a level more
        at = part = 0
        again: tuple[int, int] | None = None
        while at < len(names):
            if part < len(parts) and parts[part] == ANY:
                part += 1
                again = (part, at)
            elif part < len(parts) and parts[part] == names[at]:
                part, at = part + 1, at + 1
            elif again is not None:
                again = (again[0], again[1] + 1)
                part, at = again
            else:
                return False
        return all(each == ANY for each in parts[part:])


ROOT = FramePath((), False)
"""The path of a frame that has no parent."""


def parse_path(text: str) -> FramePath:
    """Return the path that a `Parent` states; without parts for a root (empty, or a slash alone)."""
    parts: list[str] = []
    for part in (each.strip() for each in text.split("/")):
        if part == ".." and parts and parts[-1] != ANY:
            parts.pop()
        elif part not in ("", ".", ".."):
            parts.append(part)
    return FramePath(tuple(parts), text.startswith("/"))


class Ancestry:
    """The names above frames, walked along `parents` (key of a frame to key of its parent, "" for a root).

    A frame that is not in `parents` is not placed yet.
    """

    def __init__(self, names: Mapping[str, str], parents: Mapping[str, str]):
        self._names = names
        self._parents = parents
        self.steps = 0

    @property
    def is_exhausted(self) -> bool:
        """Whether more levels were walked than a file may take."""
        return self.steps > GREATEST_STEPS

    def match(self, path: FramePath, names: Sequence[str]) -> bool:
        """Return whether a path names the frame with these names; False once the file is exhausted."""
        self.steps += len(names) * (len(path.parts) if ANY in path.parts else 1)
        return not self.is_exhausted and path.matches(names)

    def of(self, key: str) -> list[str] | None:
        """Return the names from the root down to a frame; None where one is not placed yet, or they form a cycle."""
        found: list[str] = []
        seen: set[str] = set()
        while key:
            self.steps += 1
            if key in seen or key not in self._parents or self.is_exhausted:
                return None
            seen.add(key)
            found.append(self._names[key])
            key = self._parents[key]
        return found[::-1]
