"""Modbus: requests, replies and failures as values, and numbers in registers."""
