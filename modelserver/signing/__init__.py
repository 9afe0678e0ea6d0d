"""Signed commands: key files, signatures, and protection against replayed messages."""
