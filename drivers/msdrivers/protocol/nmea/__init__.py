"""NMEA 0183: sentences of any talker, assembled to epochs."""

from msdrivers.protocol.nmea.epochs import EpochAssembler, NmeaEpoch
from msdrivers.protocol.nmea.sentences import NmeaSentence, SentenceFormat

__all__ = ["EpochAssembler", "NmeaEpoch", "NmeaSentence", "SentenceFormat"]
