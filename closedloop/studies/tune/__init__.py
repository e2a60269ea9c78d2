"""Tuning: numbers of a scenario that minimise a value of its runs, under constraints and variations."""
