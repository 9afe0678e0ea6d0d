"""Journal (black box): sealed segments of all inputs and outputs, and its verification by replay."""
