"""Numbers on the page: a text field each, so that what is typed stays as it is typed."""

from __future__ import annotations

import html
import queue
from collections.abc import Callable, Sequence
from typing import Any, Final

import viser

from modelserver.formats.common import format_number, parse_number
from mstools.edit.yaml_text import EditError

PRECISION: Final = 6
"""Decimals of a field."""

_MINUS: Final = str.maketrans(dict.fromkeys("\u2212\u2010\u2011\u2012\u2013\u2014\ufe63\uff0d", "-"))
"""Minus signs and dashes that keyboards and other programs write."""

_RED: Final = '<span style="color: #c92a2a; font-size: 0.8em">{}</span>'


def parse_typed(text: str) -> float:
    """Return the number that was typed: with a sign, an exponent, a decimal comma. Raises ValueError."""
    plain = text.strip().translate(_MINUS)
    if plain.count(",") == 1 and "." not in plain:
        plain = plain.replace(",", ".")
    return parse_number(plain)


class NumberFields:
    """Fields of numbers with one label each. What is no number is marked in red, and stays."""

    def __init__(
        self,
        gui: viser.GuiApi,
        labels: Sequence[str],
        values: Sequence[float],
        actions: queue.SimpleQueue[Callable[[], None]],
    ):
        self._labels = tuple(labels)
        self._texts: list[Any] = [
            gui.add_text(label, _format(value)) for label, value in zip(labels, values, strict=True)
        ]
        self._problem: Any = gui.add_html("")
        for each in self._texts:
            each.on_update(lambda event: actions.put(self.mark) if event.client_id is not None else None)

    @property
    def value(self) -> tuple[float, ...]:
        """The numbers. Raises EditError for a text that is none."""
        return tuple([self._parse(label, each.value) for label, each in zip(self._labels, self._texts, strict=True)])

    @value.setter
    def value(self, numbers: Sequence[float]) -> None:
        for each, number in zip(self._texts, numbers, strict=True):
            each.value = _format(number)
        self.mark()

    @property
    def texts(self) -> tuple[str, ...]:
        return tuple([str(each.value) for each in self._texts])

    @texts.setter
    def texts(self, words: Sequence[str]) -> None:
        for each, word in zip(self._texts, words, strict=True):
            each.value = word
        self.mark()

    @property
    def problem(self) -> str:
        """Why the numbers cannot be read, empty if they can."""
        try:
            _ = self.value
        except EditError as error:
            return str(error)
        return ""

    def mark(self) -> None:
        problem = self.problem
        self._problem.content = _RED.format(html.escape(problem)) if problem else ""

    @staticmethod
    def _parse(label: str, text: str) -> float:
        try:
            return parse_typed(text)
        except ValueError as error:
            raise EditError(f"{label}: {error}") from None


def _format(value: float) -> str:
    return format_number(round(value, PRECISION) + 0.0)
