"""The black box: what the loop handles and says, in sealed segments, and the proof that it can be done again."""
