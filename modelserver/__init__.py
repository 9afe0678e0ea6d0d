"""ModelServer."""

from modelserver.version import __version__ as __version__
