"""Third-party recordings as LCM event logs of this project's types, each with its vehicle file.

Every module here has `convert(data, log)`: it reads its files below `data`, the folder of recordings, and writes the
log. Its docstring states how the recording's conventions were determined, with the measured values.
"""
