"""The way of a request: whose turn it is, what is signed, what is answered."""
