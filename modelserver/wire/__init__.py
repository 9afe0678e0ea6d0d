"""The wire protocol: channels, codecs between bytes and message values, LCM logs and URLs."""
