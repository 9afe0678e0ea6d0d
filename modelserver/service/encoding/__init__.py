"""Binary encoding of declared types for stored state: no pickle, no code in the bytes, floats bit for bit."""
