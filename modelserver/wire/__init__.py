"""The bus's side of the house: channel names, and the codec between wire types and the core's values."""
