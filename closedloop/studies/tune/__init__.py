"""Tuning: numbers of a scenario that make a value of its runs least, under constraints and variations."""
