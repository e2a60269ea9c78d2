"""The whole of what is asked: reading, checking, overriding, units."""
