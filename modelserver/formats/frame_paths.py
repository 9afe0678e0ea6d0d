"""Paths in a frame tree: which frame a `Parent` of Miro's frame store names.

A path is names between slashes, from a frame down to its descendant: `PanTiltUnit/Pan`. `...` matches any number of
levels, `A/.../B`; `.` none; `..` removes the name before it. A path that begins with a slash begins at a root; any
other begins anywhere, so `Pan` is `.../Pan`, and a root has priority over deeper frames. NASA's frame store has the
same rules, but requires a parent before its children; here the order of the file is free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

ANY = "..."

MAX_STEPS = 2_000_000
"""Levels visited for all paths of a file: only a hostile file needs more."""


@dataclass(frozen=True, slots=True)
class FramePath:
    """A path: its names from the top down, and whether it begins at a root."""

    parts: tuple[str, ...]
    is_absolute: bool

    @property
    def name(self) -> str:
        """Name of the frame, without its ancestors."""
        return self.parts[-1] if self.parts else ""

    @property
    def is_plain(self) -> bool:
        """Whether it is a single name, which matches any frame of that name."""
        return len(self.parts) == 1 and not self.is_absolute

    def matches(self, names: Sequence[str]) -> bool:
        """Return whether the path matches a frame, given the names from its root down to its own."""
        if ANY not in self.parts:
            above = len(names) - len(self.parts)
            return above >= 0 and (not self.is_absolute or above == 0) and tuple(names[above:]) == self.parts
        parts = self.parts if self.is_absolute else (ANY, *self.parts)
        # glob matching: on a mismatch, backtrack to the last wildcard, which takes one more level
        at = part = 0
        backtrack: tuple[int, int] | None = None
        while at < len(names):
            if part < len(parts) and parts[part] == ANY:
                part += 1
                backtrack = (part, at)
            elif part < len(parts) and parts[part] == names[at]:
                part, at = part + 1, at + 1
            elif backtrack is not None:
                backtrack = (backtrack[0], backtrack[1] + 1)
                part, at = backtrack
            else:
                return False
        return all(each == ANY for each in parts[part:])


ROOT = FramePath((), False)
"""The path of a frame without a parent."""


def parse_path(text: str) -> FramePath:
    """Parse a `Parent`; the path of a root (empty, or a single slash) has no parts."""
    parts: list[str] = []
    for part in (each.strip() for each in text.split("/")):
        if part == ".." and parts and parts[-1] != ANY:
            parts.pop()
        elif part not in ("", ".", ".."):
            parts.append(part)
    return FramePath(tuple(parts), text.startswith("/"))


class Ancestry:
    """The names of the ancestors of frames, by `parents`: the key of each frame's parent, "" for a root.

    The parent of a frame that is not in `parents` is not known yet.
    """

    def __init__(self, names: Mapping[str, str], parents: Mapping[str, str]):
        self._names = names
        self._parents = parents
        self.steps = 0

    @property
    def is_exhausted(self) -> bool:
        """Whether more than `MAX_STEPS` levels were visited."""
        return self.steps > MAX_STEPS

    def match(self, path: FramePath, names: Sequence[str]) -> bool:
        """Return whether a path matches the frame with these names; False when exhausted."""
        self.steps += len(names) * (len(path.parts) if ANY in path.parts else 1)
        return not self.is_exhausted and path.matches(names)

    def of(self, key: str) -> list[str] | None:
        """Return the names from the root down to a frame; None if a parent is not known yet, or for a cycle."""
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
