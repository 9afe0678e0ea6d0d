"""What the core knows, as bytes and back, so that a run can be gone on with from there, bit for bit.

Python's pickle, because the state is some eighty kinds of value that change from version to version, and a journal is
read by the very build that wrote it. Reading takes only what this project's pure packages define (they touch neither
file, bus nor process), numpy's arrays and a few plain containers: a file that names anything else is refused, not run.

A state is immutable and may be written while the loop goes on. Three kinds of value share growing lists with their
successors, and are copied first: the history of poses, of which only the last seconds are kept, and the joints'.
"""

from __future__ import annotations

import gc
import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import BuiltinFunctionType, FunctionType, MappingProxyType, ModuleType
from typing import Any, ClassVar, Final

from modelserver.core import CoreState
from modelserver.errors import RecordingError

KEPT_S: Final = 2.0
"""Seconds of the history of poses that are written: all of it would be fifty times as much."""

CHUNK: Final = 40
"""Values between two pauses: a fifth of a millisecond of work, half a one at most."""

CONFIG: Final = "modelserver.config"
"""Of this one only the classes are taken: its functions read files."""

PURE: Final = (
    "core", "earth", "errors", "geodesy", "geometry", "history", "joint_reading", "joint_track", "joints",
    "localization", "magnetism", "messages", "platform", "reload", "spatial",
)  # fmt: skip

PLAIN: Final = {
    "array": {"array", "_array_reconstructor"},
    "builtins": {"complex", "frozenset", "set", "object"},
    "collections": {"OrderedDict"},
    "copyreg": {"_reconstructor", "__newobj__"},
    "functools": {"partial"},
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    # numpy 1
    "numpy.core.multiarray": {"_reconstruct", "scalar"},
    "numpy.core.numeric": {"_frombuffer"},
}
"""What is taken beside the project's own classes; none of it can do more than make a value."""


def _mapping(content: dict[Any, Any]) -> Mapping[Any, Any]:
    return MappingProxyType(content)


class _Writer(pickle.Pickler):
    """Pauses again and again: another thread waits for the interpreter, and must not wait long."""

    def __init__(self, file: io.BytesIO, pause: Callable[[], object]):
        super().__init__(file, protocol=5)
        self._pause = pause
        self._left = CHUNK

    def reducer_override(self, value: Any) -> Any:
        self._left -= 1
        if not self._left:
            self._left = CHUNK
            self._pause()
        if isinstance(value, MappingProxyType):
            return _mapping, (dict(value),)
        return NotImplemented


class _Reader(pickle._Unpickler):
    # Python's own, for what C's does not let one do: no state is set on a class or a module, which would change what
    # runs here
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def load_build(self) -> None:
        target = self.stack[-2]  # type: ignore[attr-defined]
        if isinstance(target, (type, ModuleType, FunctionType, BuiltinFunctionType)):
            raise pickle.UnpicklingError(f"a state for {target!r:.60} has no place in a journal")
        super().load_build()  # type: ignore[misc]

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module: str, name: str) -> Any:
        if module in PLAIN and name in PLAIN[module]:
            return super().find_class(module, name)
        if module == __name__ and name == _mapping.__name__:
            return _mapping
        package, *inner = module.split(".")[:2]
        if "." not in name and (module == CONFIG or (package == "modelserver" and inner and inner[0] in PURE)):
            found = super().find_class(module, name)
            # not what is only imported there
            if found.__module__ == module and (isinstance(found, type) or module != CONFIG):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} has no place in a journal")


def written(value: object, pause: Callable[[], object] = lambda: None) -> bytes:
    """Return a value as bytes; `pause` is called after every fifth of a millisecond or so.

    Raises PicklingError and what else a value raises that cannot be written.
    """
    file = io.BytesIO()
    collecting = gc.isenabled()
    # it makes much that lasts a moment: looking for circles in all that the process holds would stop both threads
    gc.disable()
    try:
        _Writer(file, pause).dump(value)
    finally:
        if collecting:
            gc.enable()
    return file.getvalue()


def apart(state: CoreState) -> CoreState:
    """Return a state that shares nothing with its successors, with no more history than is written."""
    view = state.view
    return state._replace(view=replace(view, history=view.history.recent(KEPT_S), joints=view.joints.apart()))


def read(data: bytes) -> Any:
    """Return what `written` made bytes of. Raises RecordingError where they are of another build, or no such bytes."""
    try:
        return _Reader(io.BytesIO(data)).load()
    except Exception as error:
        raise RecordingError(
            f"a state in the journal cannot be read: {error}; it is read by the build that wrote it"
        ) from error
