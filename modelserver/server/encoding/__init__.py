"""Binary encoding of declared types: no pickle, no code in the bytes, floats bit for bit."""
