"""A simulator corrected: numbers that its file has are moved in place, effects that it cannot say go beside it."""
