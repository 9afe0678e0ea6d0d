"""The error of this package."""

from __future__ import annotations

from modelserver.errors import ModelServerError


class CalibrationError(ModelServerError, ValueError):
    """The samples do not determine the result; the message states what is missing and what to do."""
