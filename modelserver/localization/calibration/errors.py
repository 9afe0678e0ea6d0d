"""The one error of this package."""

from __future__ import annotations

from modelserver.errors import ModelServerError


class CalibrationError(ModelServerError, ValueError):
    """The samples do not determine what was asked for; the message says what is missing and what to do."""
