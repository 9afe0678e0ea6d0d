"""Recordings of others as LCM event logs of this project's types, each with its vehicle file.

Every module here has `convert(data, log)`: it reads its files below `data`, the folder of recordings, in place, and
writes the log. Its docstring says how the recording's conventions were found, with the figures measured.
"""
